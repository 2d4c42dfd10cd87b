"""Initial lenses of the cameras of a source."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.capture.photos import PhotoHeaders
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size, camera_from_focal_length
from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens

# Focal length over the longer image side: 71 degrees, as most drones have. It is estimated in any case.
_GUESSED_FOCAL_SHARE = 0.7
# Relative standard deviations: of a calibration, and of a field of view, which makers round and often state
# for the diagonal or before a crop.
_GIVEN_SIGMA, _FOV_SIGMA = 0.005, 0.05
_PHOTO_SIGMA = 0.05


def start_lenses(
    frames: Frames,
    photos: PhotoHeaders | None,
    fov_deg: Mapping[str, float],
    given: Mapping[str, Camera],
) -> dict[str, InitialLens]:
    """Return the initial lens of each camera of one source: given, from photo metadata, or a guess.

    What the user gives applies only to the first camera of the source, because another zoom is another lens.

    Parameters
    ----------
    frames : Frames
        Frames of the source.
    photos : PhotoHeaders or None
        Metadata of its photos.
    fov_deg : mapping of str to float
        Horizontal field of view by sequence; "*" for all.
    given : mapping of str to Camera
        Calibrated cameras by sequence; "*" for all.

    Returns
    -------
    dict of str to InitialLens
        By camera key.

    Raises
    ------
    InputError
        If a given camera has another image shape than the frames.
    """
    lenses = {}
    sequence = str(frames.sequences[0])
    for key in np.unique(frames.cameras[frames.width > 0]).tolist():
        row = int(np.flatnonzero((frames.cameras == key) & (frames.width > 0))[0])
        width, height = int(frames.width[row]), int(frames.height[row])
        fov = camera = None
        if key == sequence:
            fov = fov_deg.get(sequence, fov_deg.get("*"))
            camera = given.get(sequence, given.get("*"))
        focal_px = None if photos is None else photos.focal_px(row)
        if camera is not None:
            camera = camera_at_size(camera, width, height, sequence)
            lens = InitialLens(camera, _GIVEN_SIGMA, "given")
        elif fov is not None:
            camera = Camera.from_horizontal_fov(width, height, fov, (0.0,))
            what = f"horizontal field of view of {fov:g} deg, as given"
            lens = InitialLens(camera, _FOV_SIGMA, what)
        elif focal_px is not None:
            camera = camera_from_focal_length(focal_px, width, height)
            lens = InitialLens(camera, _PHOTO_SIGMA, "photo metadata")
        else:
            guess = _GUESSED_FOCAL_SHARE * max(width, height)
            camera = camera_from_focal_length(guess, width, height)
            lens = InitialLens(camera, GUESS_SIGMA, "guess")
        lenses[key] = lens
    return lenses
