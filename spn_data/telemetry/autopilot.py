"""pymavlink, imported without the settings that it takes from the environment."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from spn_data.media.extras import import_extra

# Read by pymavlink when it is imported: the first two choose a dialect, which may be generated and written
# into its folder; the third accepts damaged messages; the last the indexer.
_SETTINGS = ("MAVLINK_DIALECT", "MAVLINK20", "MAV_IGNORE_CRC", "PYMAVLINK_FAST_INDEX")


def pymavlink(module: str, what: str, path: Path) -> Any:
    """Import a module of pymavlink with ArduPilot's dialect of MAVLink 2, and leave the environment alone."""
    before = {name: os.environ.pop(name, None) for name in _SETTINGS}
    os.environ["MAVLINK_DIALECT"], os.environ["MAVLINK20"] = "ardupilotmega", "1"
    try:
        return import_extra(f"pymavlink.{module}", "ardupilot", what, path)
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
