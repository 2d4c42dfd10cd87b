"""Tests of the lens from which a camera starts: what states it, how well, and what is held."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from spn_data.capture.frames import Frames
from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, Hold, InitialLens
from spn_data.inputs.initial_cameras import start_lenses
from spn_data.inputs.lens_file import read_lenses, write_lenses

_NAN = np.full(2, np.nan)
_FLIGHT = np.array(["flight"] * 2)
# Two frames of one video of 960 x 540.
FRAMES = Frames(
    names=np.array(["flight/0.jpg", "flight/1.jpg"]),
    sequences=_FLIGHT,
    cameras=_FLIGHT,
    sources=_FLIGHT,
    video_frame=np.arange(2),
    time_s=np.arange(2.0),
    status=np.array(["chosen"] * 2),
    reason=np.array(["chosen"] * 2),
    sharpness=_NAN,
    motion_px=_NAN,
    width=np.full(2, 960),
    height=np.full(2, 540),
    lat_lon_deg=np.full((2, 2), np.nan),
    rel_alt_m=_NAN,
    abs_alt_m=_NAN,
    sigma_m=np.full((2, 3), np.nan),
    gimbal_deg=np.full((2, 3), np.nan),
)


def camera(widths: float) -> Camera:
    """Return a camera whose focal length is a number of image widths."""
    return Camera("SIMPLE_PINHOLE", 960, 540, np.array([widths * 960, 480.0, 270.0]))


def started(
    *, widths: float | None = None, fov_deg: float | None = None, fixed: bool = False
) -> tuple[InitialLens, list[str]]:
    """Return the initial lens of the flight, and the notes."""
    given = {} if widths is None else {"*": camera(widths)}
    fov = {} if fov_deg is None else {"*": fov_deg}
    lenses, notes = start_lenses(FRAMES, None, fov, given, fixed=fixed)
    return lenses["flight"], notes


def test_each_source_of_a_focal_length_has_its_sigma() -> None:
    """A calibration is known better than a field of view, and a guess is not known."""
    given, by_fov, guess = started(widths=0.8)[0], started(fov_deg=64.0)[0], started()[0]
    assert given.focal_sigma < by_fov.focal_sigma < guess.focal_sigma == GUESS_SIGMA
    assert [lens.focal_is_known for lens in (given, by_fov, guess)] == [True, True, False]
    assert by_fov.camera.focal_px[0] == pytest.approx(480 / np.tan(np.deg2rad(32)))
    assert by_fov.camera.horizontal_fov_deg == pytest.approx(64.0)


def test_what_is_held() -> None:
    """Nothing is held unasked, but telephoto lenses, with a note; --fixed-lens holds only what is stated."""
    for one, hold in (
        (started(widths=0.8), Hold.NOTHING),
        (started(widths=9.0), Hold.NOTHING),
        (started(fov_deg=64.0, fixed=True), Hold.FOCAL),
        (started(widths=0.8, fixed=True), Hold.LENS),
    ):
        assert (one[0].hold, one[1]) == (hold, [])
    for lens, notes in (
        started(widths=62.0),
        started(fov_deg=0.92),
        started(fov_deg=0.92, fixed=True),
    ):
        assert lens.hold is Hold.LENS
        assert len(notes) == 1
        assert "62 image widths" in notes[0]
    with pytest.raises(InputError, match="nothing states the focal length of camera 'flight'"):
        started(fixed=True)


def test_the_lenses_of_an_area_are_written_and_read(tmp_path: Path) -> None:
    """cameras.json gives back each lens; files of an earlier version have no sigma and hold nothing."""
    lens = InitialLens(camera(62.0), 0.005, "given", Hold.LENS)
    write_lenses(
        tmp_path, {"flight": lens, "guess": InitialLens(camera(0.7), GUESS_SIGMA, "guess")}
    )
    found = read_lenses(tmp_path)
    assert (found["flight"].focal_sigma, found["flight"].source) == (0.005, "given")
    assert found["flight"].hold is Hold.LENS
    assert np.array_equal(found["flight"].camera.params, lens.camera.params)
    path = tmp_path / "cameras.json"
    table = json.loads(path.read_text())
    for one in table["cameras"].values():
        del one["focal_sigma"], one["hold"]
    path.write_text(json.dumps(table))
    earlier = read_lenses(tmp_path)
    assert earlier["flight"].focal_is_known
    assert earlier["flight"].hold is Hold.NOTHING
    assert not earlier["guess"].focal_is_known
    for damage in ({"focal_sigma": -1}, {"focal_sigma": "x"}, {"hold": "wings"}, {"params": []}):
        damaged = {"version": 1, "cameras": {"flight": lens.to_json() | damage}}
        path.write_text(json.dumps(damaged))
        with pytest.raises(FormatError, match="is not a list of cameras"):
            read_lenses(tmp_path)
