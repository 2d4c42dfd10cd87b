"""Start intrinsics of the cameras of a source."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.capture.photos import PhotoHeaders
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size, camera_from_focal_length, camera_to_json

# Of the longer side: a 71-degree lens, as most drones carry; taken as unknown and estimated.
_GUESSED_FOCAL_SHARE = 0.7


def start_cameras(
    frames: Frames,
    photos: PhotoHeaders | None,
    fov_deg: Mapping[str, float],
    given: Mapping[str, Camera],
) -> dict[str, dict[str, Any]]:
    """Each camera of one source, by key: the user's, by the photo's own metadata, or a guess.

    What the user gives holds for the source's first camera: another zoom is another lens.
    Raises InputError where a given camera is of another image shape.
    """
    cameras = {}
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
            camera, source = camera_at_size(camera, width, height, sequence), "given"
        elif fov is not None:
            camera = Camera.from_horizontal_fov(width, height, fov, (0.0,))
            source = f"horizontal field of view of {fov:g} deg, as given"
        elif focal_px is not None:
            camera, source = camera_from_focal_length(focal_px, width, height), "photo metadata"
        else:
            guess = _GUESSED_FOCAL_SHARE * max(width, height)
            camera, source = camera_from_focal_length(guess, width, height), "guess"
        cameras[key] = {
            **camera_to_json(camera),
            "focal_is_known": source != "guess",
            "source": source,
        }
    return cameras
