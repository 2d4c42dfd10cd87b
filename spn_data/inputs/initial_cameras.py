"""Initial intrinsics of the cameras of a source."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.capture.photos import PhotoHeaders
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size, camera_from_focal_length, camera_to_json
from spn_data.telemetry import misb_klv
from spn_data.telemetry.track import Telemetry

# Focal length over the longer image side: 71 degrees, as most drones have. It is estimated in any case.
_GUESSED_FOCAL_SHARE = 0.7


def start_cameras(
    frames: Frames,
    photos: PhotoHeaders | None,
    fov_deg: Mapping[str, float],
    given: Mapping[str, Camera],
    track: Telemetry | None = None,
) -> dict[str, dict[str, Any]]:
    """Return the initial intrinsics of each camera of one source: given, stated, or a guess.

    Stated is the focal length in photo metadata, or the median field of view in MISB metadata of a video.

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
    track : Telemetry or None
        Telemetry of the source.

    Returns
    -------
    dict of str to dict
        Camera as JSON by camera key, with "focal_is_known" and "source".

    Raises
    ------
    InputError
        If a given camera has another image shape than the frames.
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
        elif (share := _stated_share(track, frames.time_s[frames.cameras == key])) is not None:
            camera = camera_from_focal_length(share * width, width, height)
            source = "field of view in the video's metadata"
        else:
            guess = _GUESSED_FOCAL_SHARE * max(width, height)
            camera, source = camera_from_focal_length(guess, width, height), "guess"
        cameras[key] = {
            **camera_to_json(camera),
            "focal_is_known": source != "guess",
            "source": source,
        }
    return cameras


def _stated_share(track: Telemetry | None, time_s: np.ndarray) -> float | None:
    """Return the median focal length over the image width that telemetry states at times (N,), if any."""
    if track is None or track.kind != misb_klv.KIND or len(track) == 0:
        return None
    shares = track.at(time_s).zoom
    shares = shares[np.isfinite(shares)]
    return float(np.median(shares)) if len(shares) else None
