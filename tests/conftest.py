"""Fixtures shared by several test modules."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# A size in the environment when a console is made would hold against the size that a test sets.
for _size in ("COLUMNS", "LINES"):
    os.environ.pop(_size, None)

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SHARED_CASES = SHARED_DATA.parent / "cases"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real drone data, which is kept outside the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real drone data is not at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """Return the folder of inputs that once caused failures, which is kept outside the repository."""
    if not SHARED_CASES.is_dir():
        pytest.skip(f"the inputs that went wrong once are not at {SHARED_CASES}")
    return SHARED_CASES


@pytest.fixture(scope="module")
def tiny_kind() -> Iterator[None]:
    """Register the small network of `tests.worlds.training_world` for recipes and checkpoints."""
    from spn_model.models.registry import KINDS
    from tests.worlds.training_world import register_tiny

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spn_model.models.registry.KINDS", dict(KINDS))
        register_tiny()
        yield


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a data set of the coloured field of `tests.worlds.training_world`."""
    from tests.worlds.training_world import write_field

    return write_field(tmp_path_factory.mktemp("field") / "dataset.h5")


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Use one thread, which is fastest for networks this small, and seed the weights."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def flight1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of one simulated flight of 9 s at 320 x 180: flight1.mp4 and flight1.SRT."""
    from tests.worlds.short_flights import write_flight1

    return write_flight1(tmp_path_factory.mktemp("short") / "flights")


@pytest.fixture(scope="session")
def flight2(flight1: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of flight2.mp4 and flight2.SRT: most of the first flight, flown backwards."""
    from tests.worlds.short_flights import write_flight2

    return write_flight2(tmp_path_factory.mktemp("backwards"), flight1)


@pytest.fixture(scope="session")
def finished_area(flight1: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a complete area reconstructed from the short flight; tests must not change it."""
    from click.testing import CliRunner
    from spn_cli.data import main

    area = tmp_path_factory.mktemp("finished") / "area"
    options = ["--max-features", "800", "--threads", "1", "--fov", "72"]
    result = CliRunner().invoke(main, ["reconstruct", str(flight1), "--area", str(area), *options])
    assert result.exit_code == 0, result.output
    return area
