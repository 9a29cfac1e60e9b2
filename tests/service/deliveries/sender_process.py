"""A sender in a process of its own, to be killed: `... sender_process.py SETTINGS CLAIM_S`."""

import sys
import threading

from stillpath.service.settings import Settings
from tests.service.deliveries.places import Place

if __name__ == "__main__":
    place = Place(Settings.model_validate_json(sys.argv[1]))
    place.sender(claim_s=float(sys.argv[2])).start()
    threading.Event().wait()
