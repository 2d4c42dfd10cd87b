"""Fixtures shared by several test modules."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

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
    from spn_data.simulate import preset, simulate

    options = replace(
        preset("standard", seed=3),
        width=320,
        height=180,
        fps=2.0,
        length_factor=0.12,
        texels_per_m=40.0,
        only=("flight1",),
    )
    out = tmp_path_factory.mktemp("short") / "flights"
    simulate(out, options, workers=1)
    return out / "mapping"


@pytest.fixture(scope="session")
def flight2(flight1: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of flight2.mp4 and flight2.SRT: most of the first flight, flown backwards."""
    import av

    folder = tmp_path_factory.mktemp("backwards")
    with av.open(str(flight1 / "flight1.mp4")) as container:
        images = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    with av.open(str(folder / "flight2.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=2)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images[:3:-1]:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())
    records = [text.splitlines() for text in (flight1 / "flight1.SRT").read_text().split("\n\n")]
    records = [lines for lines in records if len(lines) > 2]
    turned = [[*a[:-1], b[-1]] for a, b in zip(records, records[:3:-1], strict=False)]
    text = "\n\n".join("\n".join(lines) for lines in turned)
    (folder / "flight2.SRT").write_text(text + "\n\n")
    return folder


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
