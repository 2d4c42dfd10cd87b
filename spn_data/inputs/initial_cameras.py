"""Initial lenses of the cameras of a source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.capture.photos import PhotoHeaders
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size, camera_from_focal_length
from spn_data.geometry.initial_lens import GUESS_SIGMA, Hold, InitialLens

# Focal length over the longer image side: 71 degrees, as most drones have. It is estimated in any case.
_GUESSED_FOCAL_SHARE = 0.7
# Relative standard deviations of focal lengths: of a calibration, and of a field of view, which makers round
# and often state for the diagonal or before a crop.
_GIVEN_SIGMA, _FOV_SIGMA = 0.005, 0.05
# Focal length in image widths above which it is held. On an orbit of 12 images with exact matches and 0.3 px
# of noise, 14 are still estimated to 0.7 %; at 20, 4 images register unless the lens is held.
_TELEPHOTO = 10.0


def start_lenses(
    frames: Frames,
    photos: PhotoHeaders | None,
    fov_deg: Mapping[str, float],
    given: Mapping[str, Camera],
    *,
    fixed: bool = False,
) -> tuple[dict[str, InitialLens], list[str]]:
    """Return the initial lens of each camera of one source: given, from photo metadata, or a guess.

    What the user gives applies only to the first camera of the source, because another zoom is another lens.
    The lens of a stated telephoto is held in any case: its focal length hardly changes the perspective.

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
    fixed : bool
        Whether to hold given cameras, and focal lengths that are stated otherwise.

    Returns
    -------
    lenses : dict of str to InitialLens
        By camera key.
    notes : list of str
        One sentence each: what contradicts, and which lenses are held without being asked for.

    Raises
    ------
    InputError
        If a given camera has another image shape than the frames, or nothing states a focal length that is to
        be held.
    """
    lenses, notes = {}, []
    sequence = str(frames.sequences[0])
    for key in np.unique(frames.cameras[frames.width > 0]).tolist():
        row = int(np.flatnonzero((frames.cameras == key) & (frames.width > 0))[0])
        size = int(frames.width[row]), int(frames.height[row])
        fov = camera = None
        if key == sequence:
            fov = fov_deg.get(sequence, fov_deg.get("*"))
            camera = given.get(sequence, given.get("*"))
        if camera is not None:
            lens = InitialLens(camera_at_size(camera, *size, sequence), _GIVEN_SIGMA, "given")
        elif fov is not None:
            lens = InitialLens(
                Camera.from_horizontal_fov(*size, fov, (0.0,)),
                _FOV_SIGMA,
                f"horizontal field of view of {fov:g} deg, as given",
            )
        else:
            lens, doubt = _unasked(photos, row, size)
            notes += [f"{key}: {doubt}"] if doubt else []
        lenses[key], held = _held(key, lens, fixed=fixed, whole=camera is not None)
        notes += held
    return lenses, notes


def _unasked(
    photos: PhotoHeaders | None, row: int, size: tuple[int, int]
) -> tuple[InitialLens, str]:
    """Return the lens by the metadata of a photo, or a guess, and a note if the metadata contradict."""
    stated, doubt = (None, "") if photos is None else photos.focal(row)
    if stated is not None:
        camera = camera_from_focal_length(stated.focal_px, *size)
        return InitialLens(camera, stated.sigma, stated.source), doubt
    guess = camera_from_focal_length(_GUESSED_FOCAL_SHARE * max(size), *size)
    return InitialLens(guess, GUESS_SIGMA, "guess"), doubt


def _held(
    key: str, lens: InitialLens, *, fixed: bool, whole: bool
) -> tuple[InitialLens, list[str]]:
    """Return a lens with what is held of it, and a note if that was not asked for."""
    focal_px = lens.camera.focal_px[0]
    widths = focal_px / max(lens.camera.width, lens.camera.height)
    if lens.focal_is_known and widths > _TELEPHOTO:
        return replace(lens, hold=Hold.LENS), [
            f"{key}: the focal length of {focal_px:.0f} px is {widths:.0f} image widths; images hardly "
            f"determine that of a telephoto, so it is held as stated ({lens.source})"
        ]
    if not fixed:
        return lens, []
    if not lens.focal_is_known:
        raise InputError(
            f"nothing states the focal length of camera {key!r}, so --fixed-lens has nothing to hold: give "
            "--camera or --fov, or leave out --fixed-lens"
        )
    return replace(lens, hold=Hold.LENS if whole else Hold.FOCAL), []
