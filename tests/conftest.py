"""Fixtures that more than one test module uses."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real drone data, which lies beside a checkout and is not part of the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real drone data is not at {SHARED_DATA}")
    return SHARED_DATA
