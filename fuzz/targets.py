"""Readers of files from outside, one line each: name, seeds, reader. Add a format by adding a line."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fuzz.graphs import mutated_graph
from fuzz.mutate import mutated
from spn_data.api import open_area
from spn_data.area.area import Area
from spn_data.area.facts import read_facts
from spn_data.capture.frames import read_frames
from spn_data.capture.photos import decode_photo, decode_photo_gray, load_mask, read_headers
from spn_data.capture.video import decode_gray, probe
from spn_data.colmap.map_features import MapFeatures
from spn_data.colmap.model import read_map_with_keypoints
from spn_data.coverage.sequence_table import read_strata
from spn_data.coverage.waypoints import WaypointFrame, read_waypoints
from spn_data.dataset.cambridge import read_cambridge
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.nvm import read_nvm_models
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import read_camera
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.ground_control.control_file import read_control_file
from spn_data.ground_control.coordinates import surveyed_positions
from spn_data.inputs.area_labels import read_written_world
from spn_data.inputs.expected_plans import read_expected_plans
from spn_data.inputs.network_runs import read_runs
from spn_data.inputs.run_estimates import read_estimates
from spn_data.labels.labels import read_label_observations, read_labels
from spn_data.pipeline.area_audit import read_audit
from spn_data.pipeline.area_coverage import read_coverage
from spn_data.pipeline.area_report import write_report
from spn_data.pipeline.import_cambridge import ImportOptions, import_cambridge
from spn_data.reconstruction.registration_file import read_reasons
from spn_data.split.split_file import read_split
from spn_data.storage.stage_record import read_record
from spn_data.telemetry.camm import read_camm
from spn_data.telemetry.data_tracks import DataPacket
from spn_data.telemetry.embedded import read_embedded
from spn_data.telemetry.exif import read_photo, telemetry_from_photos
from spn_data.telemetry.gpmf import read_gpmf
from spn_data.telemetry.misb_klv import read_misb
from spn_data.telemetry.read import read_telemetry
from spn_data.telemetry.subtitles import read_subtitles
from spn_data.telemetry.table import read_track
from spn_model.evaluation.results import read_run
from spn_model.models.checkpoint import load
from spn_model.onboard.attitude import Attitude, read_attitude
from spn_model.onboard.bundle import GRAPHS, read_bundle, sha256_of
from spn_model.onboard.height import BarometerHeights, read_heights
from spn_model.onboard.localizer import Localizer
from spn_model.onboard.sources import frames as onboard_frames
from spn_model.pretrained.tensors import read_tensors
from spn_model.runs.run_availability import measured_usable
from spn_model.runs.run_files import RunFiles
from spn_model.training.recipe import read_recipe
from spn_model.training.training_figure import read_log
from spn_model.training.training_state import read_state

_FRAMES = 4  # decoded of each video
_CAMERA = Camera("SIMPLE_PINHOLE", 640, 360, np.array([400.0, 320.0, 180.0]))
_PLACE = WaypointFrame(GeoOrigin(49.0, 8.4, 120.0, HeightReference.TAKEOFF), 0.0)


@dataclass(frozen=True)
class Target:
    """One reader and the valid files that its inputs are made from.

    Attributes
    ----------
    name : str
        Name in the table of results.
    seeds : str
        Pattern of seed files in the folder of seeds; several are separated by spaces.
    read : callable
        Reads the mutated file, whose path it gets.
    above : int
        Number of folders above the file that belong to the input and are copied with it.
    mutate : callable
        From bytes and random numbers to other bytes.
    """

    name: str
    seeds: str
    read: Callable[[Path], object]
    above: int = 0
    mutate: Callable[[bytes, random.Random], bytes] = mutated

    def files(self, folder: Path) -> list[Path]:
        """Return the seed files in a folder of seeds, sorted."""
        return sorted(
            p for pattern in self.seeds.split() for p in folder.glob(pattern) if p.is_file()
        )


def _photo(path: Path) -> None:
    telemetry_from_photos([read_photo(path)])
    read_headers([path]).focal(0)
    decode_photo(path)
    decode_photo_gray(path, max_width=640)


def _video(path: Path) -> None:
    probe(path)
    for _, _frame in zip(range(_FRAMES), decode_gray(path, threads=1), strict=False):
        pass


def _heights(path: Path) -> BarometerHeights:
    """Read a telemetry file as heights in a world whose heights count from take-off."""
    return read_heights(path, GeoOrigin(49.0, 8.4, 2.0, HeightReference.TAKEOFF))


def _attitude(path: Path) -> Attitude:
    """Read a telemetry file as the attitude of a camera."""
    return read_attitude(
        path, of="camera", mounting=None, body_from_camera=np.eye(3), sigma_deg=1.0
    )


def _payload(path: Path) -> None:
    """Read a file as the only packet of a data track, whose format is its suffix."""
    readers = {".gpmf": read_gpmf, ".camm": read_camm, ".klv": read_misb}
    packet = DataPacket(time_s=0.0, duration_s=1.0, payload=path.read_bytes(), near_s=0.0)
    readers[path.suffix]([packet], path.name)


def _onboard_frames(path: Path) -> None:
    for _, _frame in zip(range(_FRAMES), onboard_frames(path), strict=False):
        pass


def _model(path: Path) -> None:
    read_map_with_keypoints(path.parent)


def _database(path: Path) -> None:
    with MapFeatures.open(path) as features:
        features.descriptors("flight1/000000.jpg")


def _dataset(path: Path) -> None:
    with Dataset(path) as data:
        for group in data.groups.values():
            _ = (
                group.names,
                group.sequences,
                group.strata,
                group.time_s,
                group.tracked,
                group.poses,
            )
            _ = (group.covariance, group.intrinsics, group.point_ids())
            for row in range(min(2, len(group))):
                _ = (group.image(row), group.valid(row), group.points(row))
                if group.role is Role.TRAIN:
                    group.training_points(row)


def _import(path: Path) -> None:
    target = path.parent / "out.h5"
    import_cambridge(
        path.parent, target, ImportOptions(width_px=64), lambda *_: None, overwrite=True
    )


def _root(path: Path) -> Path:
    """Return the area that a file is in."""
    return next(folder for folder in path.parents if (folder / "1-frames").is_dir())


def _area(path: Path) -> None:
    root = _root(path)
    area, reader = Area(root), open_area(root)
    read_facts(root / "area.toml")
    for stage in area.stages():
        area.record(stage)
        area.stale_because(stage)
    _ = (reader.frames, reader.map, reader.sequences)
    for sequence in ("mapping", "again"):
        reader.labels(sequence)
        reader.observations(sequence)
    read_runs(area)
    read_expected_plans(area)
    read_coverage(area)
    write_report(area)


def _run(path: Path) -> None:
    area = Area(_root(path))
    runs, _ = read_runs(area)
    read_estimates(area, [replace(run, is_current=True, is_outdated=False) for run in runs])
    _ = read_run(path.parent).errors
    run = RunFiles(path.parent)
    if run.fixes.is_file():
        measured_usable(run)


def _bundle(path: Path) -> None:
    read_bundle(path.parent)
    _localize(Localizer(path.parent))


def _localize(localizer: Localizer) -> None:
    localizer.localize(np.random.default_rng(0).integers(0, 255, (360, 640, 3), np.uint8), _CAMERA)


def _graph(path: Path) -> None:
    """Load and run a graph whose hash was made to fit."""
    document = path.parent / "bundle.json"
    table = json.loads(document.read_text())
    precision = next(p for p, name in GRAPHS.items() if name == path.name)
    table["graphs"][precision].update(bytes=path.stat().st_size, sha256=sha256_of(path))
    document.write_text(json.dumps(table))
    _localize(Localizer(path.parent, int8=precision == "int8"))


def _log(path: Path) -> None:
    read_log(path)


def _reasons(path: Path) -> None:
    read_reasons(path.parent)


def _recipe(path: Path) -> None:
    read_recipe(str(path))


def _control(path: Path) -> None:
    surveyed_positions(read_control_file(path))


def _waypoints(path: Path) -> None:
    read_waypoints(path, _PLACE)


def _mask(path: Path) -> None:
    load_mask(path, 64, 48)


_JSON_OF_AREA = (
    "area/*/stage.json area/*/*/stage.json area/*/*/registration.json area/3-geo/geo.json"
)
TARGETS = (
    Target("srt", "telemetry/*.SRT telemetry/*.srt", read_telemetry),
    Target("ass", "telemetry/*.ass", read_telemetry),
    Target("gpx", "telemetry/*.gpx", read_telemetry),
    Target("csv", "telemetry/*.csv telemetry/*.tsv", read_telemetry),
    Target(
        "flight logs",
        "telemetry/*.ulg telemetry/*.bin telemetry/*.tlog telemetry/*.fit telemetry/*.nmea",
        read_telemetry,
    ),
    Target("ground control", "control/*", _control),
    Target("subtitles", "subtitled/*", read_subtitles),
    Target("data tracks", "data-tracks/*.ts data-tracks/*.mp4", read_embedded),
    Target("payloads", "data-tracks/payloads/*", _payload),
    Target("photos", "photos/*", _photo),
    Target("real photos", "real-photos/*", _photo),
    Target("masks", "masks/*", _mask),
    Target("video", "video/*", _video),
    Target("camera.json", "area/4-eval/again/camera.json bundle/camera.json", read_camera),
    Target("recipe", "recipe/*", _recipe),
    Target("waypoints", "telemetry/waypoints/*", _waypoints),
    Target(
        "area", f"{_JSON_OF_AREA} area/1-frames/* area/coverage/*.json area/area.toml", _area, 9
    ),
    Target("stage.json", "area/*/stage.json area/*/*/stage.json", read_record),
    Target("registration.json", "area/*/*/registration.json", read_written_world),
    Target("split.json", "area/5-split/split.json", read_split),
    Target("audit.json", "area/5-split/audit.json", read_audit),
    Target("poses.csv", "area/4-eval/*/poses.csv area/2-model/poses.csv", read_labels),
    Target("observations.npz", "area/4-eval/*/observations.npz", read_label_observations),
    Target("frames.csv", "area/1-frames/frames.csv area/4-eval/*/frames.csv", read_frames),
    Target("telemetry.csv", "area/1-frames/telemetry/*.csv", read_track),
    Target("attitude", "area/1-frames/telemetry/*.csv", _attitude),
    Target("heights", "area/1-frames/telemetry/*.csv", _heights),
    Target("coverage.csv", "area/coverage/*.csv", read_strata),
    Target("registration.csv", "area/2-model/registration.csv", _reasons, 1),
    Target("COLMAP model", "area/3-geo/*.bin", _model, 1),
    Target("COLMAP database", "area/2-model/database.db", _database),
    Target("Cambridge lists", "area/5-split/cambridge/*.txt", read_cambridge),
    Target("NVM", "area/5-split/cambridge/*.nvm lists/*.nvm", read_nvm_models),
    Target("import", "lists/*.txt lists/*.nvm", _import, 9),
    Target("dataset.h5", "box/dataset.h5 area/5-split/dataset.h5", _dataset),
    Target("run", "area/runs/default/*.json area/runs/default/*.csv", _run, 9),
    Target("log.csv", "area/runs/default/log.csv", _log),
    Target("checkpoint", "run/checkpoint.safetensors", load),
    Target("training state", "run/state.safetensors", read_state),
    Target("weights", "weights/*.pth run/checkpoint.safetensors", read_tensors),
    Target("bundle.json", "bundle/bundle.json", _bundle, 1),
    Target("ONNX", "bundle/*.onnx", _graph, 1, mutated_graph),
    Target("on-board images", "photos/* bundle/image.jpg", _onboard_frames),
    Target("on-board video", "video/*", _onboard_frames),
)
BY_NAME = {target.name: target for target in TARGETS}
