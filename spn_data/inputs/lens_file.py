"""cameras.json of stage 1-frames: the lens from which each camera of the map starts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spn_data.area.area import Area
from spn_data.area.names import CAMERAS, FRAMES, FRAMES_TABLE, MODEL
from spn_data.capture.frames import read_frames
from spn_data.colmap.model import Scene
from spn_data.geometry.initial_lens import InitialLens
from spn_data.storage.json_files import VERSION, read_json, reporting_damage, write_json
from spn_data.uncertainty.shared_errors import LensPrior


def write_lenses(folder: Path, lenses: Mapping[str, InitialLens]) -> None:
    """Write the lenses of the cameras of stage 1-frames into its folder."""
    cameras = {key: lens.to_json() for key, lens in lenses.items()}
    write_json(folder / CAMERAS, {"version": VERSION, "cameras": cameras})


def read_lenses(folder: Path) -> dict[str, InitialLens]:
    """Read the lenses of the cameras of stage 1-frames from its folder.

    Parameters
    ----------
    folder : Path
        Folder of the stage.

    Returns
    -------
    dict of str to InitialLens
        By camera key, as in column `camera` of frames.csv.

    Raises
    ------
    FormatError
        If the file is missing or damaged.
    """
    path = folder / CAMERAS
    with reporting_damage(path, "a list of cameras"):
        cameras = read_json(path)["cameras"]
        return {str(key): InitialLens.from_json(value) for key, value in cameras.items()}


def map_lens_priors(area: Area, scene: Scene) -> dict[int, LensPrior]:
    """Return what is known of the lenses of an area's map, by camera id, for its covariance.

    Raises
    ------
    FormatError
        If files of stage 1-frames are missing or damaged.
    """
    folder = area.folder(FRAMES)
    frames, lenses = read_frames(folder / FRAMES_TABLE), read_lenses(folder)
    key_of = dict(zip(frames.names.tolist(), frames.cameras.tolist(), strict=True))
    keys = {int(i): key_of[name] for i, name in zip(scene.camera_ids, scene.names, strict=True)}
    doubts = _focal_doubts(area)
    with reporting_damage(folder / CAMERAS, "a list of the cameras of frames.csv"):
        return {i: LensPrior.of(lenses[key], doubts.get(key, 0.0)) for i, key in keys.items()}


def _focal_doubts(area: Area) -> dict[str, float]:
    """Return the error of each focal length by what contradicted the images when the map was made."""
    cameras = area.record(MODEL).counts.get("cameras", {})
    return {key: float(lens.get("focal_doubt_px", 0.0)) for key, lens in cameras.items()}
