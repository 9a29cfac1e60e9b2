"""Write the schema of report.json: ``python -m service.reports > docs/report.schema.json``."""

import sys

from service.reports.schema import schema_text

sys.stdout.buffer.write(schema_text().encode())
