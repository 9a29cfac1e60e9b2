"""Write the schema of report.json: ``python -m stillpath.reports > docs/report.schema.json``."""

import sys

from stillpath.reports.schema import schema_text

sys.stdout.buffer.write(schema_text().encode())
