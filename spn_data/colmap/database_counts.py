"""Counts of a COLMAP database that another process is writing."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

_WAIT_S = 0.2
_COUNTS = {
    "images": "SELECT COUNT(*) FROM keypoints",
    "pairs": "SELECT COUNT(*) FROM two_view_geometries",
}


def count_progress(path: Path) -> dict[str, int]:
    """Return the number of images with features and of verified pairs; empty if it cannot be read now."""
    try:
        uri = f"{path.resolve().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=_WAIT_S)) as connection:
            return {name: connection.execute(sql).fetchone()[0] for name, sql in _COUNTS.items()}
    except sqlite3.Error:
        return {}
