"""Tests of the lens from which a camera starts: what states it, how well, and what is held."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.capture.frames import Frames
from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, Hold, InitialLens
from spn_data.inputs.initial_cameras import start_lenses
from spn_data.inputs.lens_file import read_lenses, write_lenses


@pytest.fixture
def frames() -> Frames:
    """Return two frames of one video of 960 x 540."""
    return Frames.from_columns(2)


def started(frames: Frames, widths: float | None, *, fov_deg: float | None = None, fixed: bool) -> InitialLens:
    camera = None if widths is None else Camera("SIMPLE_PINHOLE", 960, 540, np.array([widths * 960, 480, 270]))
    given = {} if camera is None else {"*": camera}
    fov = {} if fov_deg is None else {"*": fov_deg}
    lenses, notes = start_lenses(frames, None, fov, given, fixed=fixed)
    assert bool(notes) == (lenses["flight"].camera.focal_px[0] > 9600)
    return lenses["flight"]
