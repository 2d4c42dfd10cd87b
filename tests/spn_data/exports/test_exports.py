"""Tests of exports of an area, read back by independent readers."""

from __future__ import annotations

import csv
import hashlib
import importlib
import json
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import click
import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy.spatial.transform import Rotation
from spn_cli.data import main
from spn_cli.export import FORMATS

from spn_data.area.area import Area, StageWork
from spn_data.area.names import CAMERA, EVALUATION, OBSERVATIONS, POSES, REGISTRATION
from spn_data.colmap import pycolmap
from spn_data.dataset.nvm import read_nvm
from spn_data.exports.exported_frames import ExportedFrames, timestamps_us
from spn_data.exports.geojson import write_geojson
from spn_data.exports.kml import write_kml
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, Similarity
from spn_data.inputs.area_labels import (
    LabelledArea,
    read_labelled_area,
    read_world_from_model,
)
from spn_data.inputs.frame_images import image_path
from spn_data.labels.labels import (
    LabelObservations,
    Labels,
    read_labels,
    write_label_observations,
    write_labels,
)
from spn_data.labels.map_points import MapPoints
from spn_data.pipeline.area_export import Format
from spn_data.storage.json_files import VERSION, write_json

ROOT = Path(__file__).resolve().parents[3]


def reader(name: str) -> ModuleType:
    """Import a package of the extra `readers`, or skip the test if it is not installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # raised by other packages during import
        try:
            return importlib.import_module(name)
        except ImportError as error:
            pytest.skip(f"{name} is not installed ({error}): pip install '.[readers]'")


def add_evaluation(root: Path) -> None:
    """Add an evaluation sequence `again` near the mapping frames, with its own lens and one failed frame."""
    area = Area(root)
    known = read_labelled_area(area)
    rows = np.flatnonzero(known.mapping.registered)[:6]
    near, seen = known.mapping.select(rows), known.mapping_seen.select(rows)
    step = Similarity(
        1.0, Rotation.from_rotvec([0.01, 0.02, -0.03]).as_matrix(), np.array([0.1, 0, 0])
    )
    poses = step.apply_to_poses(near.poses)
    poses.centers[5], poses.quats_wxyz[5] = np.nan, np.nan
    failed = np.arange(6) == 5
    labels = Labels(
        **{
            **vars(near),
            "names": np.array([f"again/{k:06d}.jpg" for k in range(6)]),
            "sequences": np.full(6, "again"),
            "cameras": np.full(6, "again"),
            "tracked": np.arange(6) == 4,
            "time_s": np.arange(6) / 2,
            "status": np.where(failed, "failed", "registered"),
            "reason": np.where(failed, "failed: too few", ""),
            "poses": poses,
        }
    )
    options: dict[str, int] = {}
    work = area.begin(f"{EVALUATION}/again", options, {}, overwrite=False)
    assert isinstance(work, StageWork)
    write_labels(work.path / POSES, labels)
    kept = seen.frame_idx != 5
    write_label_observations(
        work.path / OBSERVATIONS,
        LabelObservations(seen.frame_idx[kept], seen.point_ids[kept], seen.pixels[kept]),
    )
    lens = Camera("OPENCV", 320, 180, np.array([210.0, 211, 160.5, 89, -0.05, 0.01, 1e-3, -1e-3]))
    write_json(work.path / CAMERA, {"version": VERSION, **camera_to_json(lens)})
    moved = read_world_from_model(area).to_json()
    write_json(work.path / REGISTRATION, {"version": VERSION, "world_from_model": moved})
    work.finish(counts={}, seconds={}, cpu_seconds={})
    for k in range(4):
        stored = image_path(area, str(labels.names[k]), "again")
        stored.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / "1-frames" / str(near.names[k]), stored)


@pytest.fixture(scope="module")
def area(finished_area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a georeferenced area with an evaluation sequence; tests must not change it."""
    root = tmp_path_factory.mktemp("exported") / "area"
    shutil.copytree(finished_area, root)
    add_evaluation(root)
    return root


@pytest.fixture(scope="module")
def area_without_place(area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the same area without georegistration."""
    root = tmp_path_factory.mktemp("placeless") / "area"
    shutil.copytree(area, root)
    shutil.rmtree(root / "3-geo")
    return root


@pytest.fixture(scope="module")
def exports(area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export the area in all formats."""
    target = tmp_path_factory.mktemp("exports") / "all"
    done = run("all", target, area)
    assert done.exit_code == 0, done.output
    return target


@pytest.fixture(scope="module")
def labelled(area: Path) -> LabelledArea:
    return read_labelled_area(Area(area))


@pytest.fixture(scope="module")
def truth(area: Path) -> dict[str, np.ndarray]:
    """Return world-from-camera (4, 4) of every exported frame, computed without our own code."""
    found = {}
    for image in pycolmap.Reconstruction(str(area / "3-geo")).images.values():
        found[image.name] = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
    with (area / EVALUATION / "again" / POSES).open(newline="") as file:
        for row in csv.DictReader(file):
            if row["status"] == "registered" and row["dense"] == "0":
                pose = np.eye(4)
                cam_from_world = Rotation.from_quat(
                    [float(row[c]) for c in ("qx", "qy", "qz", "qw")]
                )
                pose[:3, :3] = cam_from_world.inv().as_matrix()
                pose[:3, 3] = [float(row[c]) for c in "xyz"]
                found[row["name"]] = pose
    assert len([name for name in found if name.startswith("again/")]) == 4
    return found


def run(format_name: str, target: Path, area: Path, *more: str) -> Result:
    words = ["export", format_name, "--to", str(target), "--area", str(area), *more]
    return CliRunner().invoke(main, words)


def test_tum_is_read_by_evo(
    exports: Path, labelled: LabelledArea, truth: dict[str, np.ndarray]
) -> None:
    """evo reads the true poses (camera to world) and times."""
    read = reader("evo.tools.file_interface").read_tum_trajectory_file
    read_files = sorted((exports / "tum").glob("*.txt"))
    assert [path.stem for path in read_files] == ["again", "flight1"]
    for path in read_files:
        labels = labelled.evaluation.get(path.stem, labelled.mapping)
        labels = labels.select(labels.registered & ~labels.tracked)
        found = read(str(path))
        assert found.check()[0], found.check()
        assert np.allclose(found.timestamps, labels.time_s, rtol=0, atol=1e-6)
        wanted = np.stack([truth[name] for name in labels.names.tolist()])
        assert np.abs(np.stack(found.poses_se3) - wanted).max() < 1e-6


def test_kapture_is_read_by_kapture(exports: Path, truth: dict[str, np.ndarray]) -> None:
    """kapture reads the true poses (world to sensor), sensors and images."""
    kapture = reader("kapture")
    found = reader("kapture.io.csv").kapture_from_dir(str(exports / "kapture"))
    names = {name: (stamp, sensor) for stamp, sensor, name in kapture.flatten(found.records_camera)}
    assert names.keys() == truth.keys()
    for name, (stamp, sensor) in names.items():
        pose = found.trajectories[stamp, sensor].inverse()
        rotation = Rotation.from_quat(np.roll(pose.r_raw, -1)).as_matrix()
        assert np.abs(rotation - truth[name][:3, :3]).max() < 1e-6
        assert np.abs(pose.t.ravel() - truth[name][:3, 3]).max() < 1e-6
        assert (exports / "kapture" / "sensors" / "records_data" / name).is_file()
    lens = found.sensors["again"]
    assert lens.camera_type == kapture.CameraType.OPENCV
    assert lens.camera_params == [320, 180, 210, 211, 160.5, 89, -0.05, 0.01, 1e-3, -1e-3]


@pytest.mark.parametrize("name", ["colmap", "colmap-text"])
def test_colmap_models_are_read_by_pycolmap(
    name: str, exports: Path, area: Path, labelled: LabelledArea, truth: dict[str, np.ndarray]
) -> None:
    """The map is unchanged, and evaluation frames have their poses, camera and observations."""
    found = pycolmap.Reconstruction(str(exports / name / "sparse" / "0"))
    source = pycolmap.Reconstruction(str(area / "3-geo"))
    images = {image.name: image for image in found.images.values()}
    assert images.keys() == truth.keys()
    for image_name, image in images.items():
        assert (
            np.abs(image.cam_from_world().inverse().matrix() - truth[image_name][:3]).max() < 1e-6
        )
        assert (exports / name / "images" / image_name).is_file()
    assert set(found.points3D) == set(source.points3D)
    for point_id, point in source.points3D.items():
        assert np.abs(found.points3D[point_id].xyz - point.xyz).max() < 1e-6
    for image_id, image in source.images.items():
        assert found.images[image_id].num_points3D == image.num_points3D
    labels, seen = labelled.evaluation["again"], labelled.evaluation_seen["again"]
    for row in np.flatnonzero(labels.registered & ~labels.tracked):
        ids, pixels = seen.of_frame(row)
        points = images[labels.names[row]].get_observation_points2D()
        assert [p.point3D_id for p in points] == ids.tolist()
        assert np.abs(np.array([p.xy for p in points]) - pixels).max() < 1e-6
        elements = found.points3D[int(ids[0])].track.elements
        assert images[labels.names[row]].image_id in {element.image_id for element in elements}
    camera = images["again/000000.jpg"].camera
    assert camera.model_name == "OPENCV"
    assert camera.params.tolist() == [210, 211, 160.5, 89, -0.05, 0.01, 1e-3, -1e-3]


def test_nerfstudio_is_as_its_documentation_says(
    exports: Path, area: Path, truth: dict[str, np.ndarray]
) -> None:
    """Map points project to the pixels where they were seen, with OpenGL camera-to-world poses.

    Derived independently from https://docs.nerf.studio/quickstart/data_conventions.html: x right, y up, z
    backwards, OpenCV's distortion; the centre of the upper-left pixel is (0.5, 0.5) as in COLMAP.
    """
    content = json.loads((exports / "nerfstudio" / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    assert content["units"] == "m"
    frames = {frame["file_path"]: frame for frame in content["frames"]}
    assert frames.keys() == {f"images/{name}" for name in truth}
    for name, pose in truth.items():
        opengl = np.array(frames[f"images/{name}"]["transform_matrix"])
        assert np.abs(opengl[:, 3] - pose[:, 3]).max() < 1e-6
        assert np.abs(opengl[:, 0] - pose[:, 0]).max() < 1e-6
        assert np.abs(opengl[:3, 1:3] + pose[:3, 1:3]).max() < 1e-6
        assert (exports / "nerfstudio" / "images" / name).is_file()
    native = pycolmap.Reconstruction(str(area / "3-geo"))
    for image in list(native.images.values())[:5]:
        seen = image.get_observation_points2D()
        world = np.array([native.points3D[p.point3D_id].xyz for p in seen])
        frame = frames[f"images/{image.name}"]
        opengl = np.c_[world, np.ones(len(world))] @ np.linalg.inv(frame["transform_matrix"]).T
        matrix = np.array(
            [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]
        )
        distortion = np.array([frame[key] for key in ("k1", "k2", "p1", "p2")])
        rays = opengl[:, :3] * [1, -1, -1]
        pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, distortion)
        miss = np.linalg.norm(pixels[:, 0] - np.array([p.xy for p in seen]), axis=1)
        assert np.median(miss) < 1.0
    evaluation = [f"images/again/{k:06d}.jpg" for k in range(4)]
    assert content["val_filenames"] == content["test_filenames"] == evaluation
    assert set(content["train_filenames"]) == frames.keys() - set(evaluation)


def test_intrinsics_of_one_camera_stand_once(area: Path, tmp_path: Path) -> None:
    """Intrinsics of a single camera are written once, at the top of the file."""
    done = run("nerfstudio", tmp_path / "out", area, "--sequence", "again", "--no-images")
    assert done.exit_code == 0, done.output
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert (content["w"], content["fl_y"], content["p2"]) == (320, 211, -1e-3)
    assert content["frames"][0].keys() == {"file_path", "transform_matrix"}
    assert "train_filenames" not in content
    assert not (tmp_path / "out" / "images").exists()


def in_world(lon_lat_height: np.ndarray, area: Path) -> np.ndarray:
    """Return east, north, up (N, 3) by COLMAP's own geodesy."""
    origin = json.loads((area / "3-geo" / "geo.json").read_text())["origin"]
    transform = pycolmap.GPSTransform()
    there = np.array([origin["lat_deg"], origin["lon_deg"], origin["alt_m"]])
    lat_lon_height = lon_lat_height[:, [1, 0, 2]]
    found = transform.ellipsoid_to_enu(lat_lon_height, *there)
    return np.array(found)


def test_geojson_is_read_by_geojson(
    exports: Path,
    area: Path,
    truth: dict[str, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """GeoJSON is valid, with positions within a millimetre and headings along the optical axis."""
    geojson = reader("geojson")
    # By default, geojson rounds coordinates to six decimals (a tenth of a metre).
    monkeypatch.setattr(reader("geojson.geometry"), "DEFAULT_PRECISION", 15)
    found = geojson.loads((exports / "geojson" / "frames.geojson").read_text())
    assert found.is_valid, found.errors()
    assert {feature.properties["name"] for feature in found.features} == truth.keys()
    places = [feature.geometry.coordinates[:2] for feature in found.features]
    heights = [[feature.properties["height_m"]] for feature in found.features]
    world = in_world(np.hstack([places, heights]), area)
    for feature, position in zip(found.features, world, strict=True):
        properties = feature.properties
        pose = truth[properties["name"]]
        assert np.abs(position - pose[:3, 3]).max() < 1e-3
        assert len(feature.geometry.coordinates) == 2
        assert properties["height_reference"] == "takeoff"
        heading, pitch = np.deg2rad([properties["heading_deg"], properties["pitch_deg"]])
        axis = [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)]
        assert np.abs(axis - pose[:3, 2]).max() < 1e-5
        role = "evaluation" if properties["sequence"] == "again" else "mapping"
        assert properties["role"] == role


def test_kml_is_read_by_fastkml(exports: Path, area: Path, truth: dict[str, np.ndarray]) -> None:
    """KML has a placemark per frame and a path per sequence, with positions within a millimetre."""
    fastkml = reader("fastkml")
    find_all = reader("fastkml.utils").find_all
    document = fastkml.KML.parse(str(exports / "kml" / "frames.kml"))
    marks = {mark.name: mark for mark in find_all(document, of_type=fastkml.Placemark)}
    assert marks.keys() == {*truth, "flight1", "again"}
    assert len(marks["again"].geometry.coords) == 4
    for name, pose in truth.items():
        mark = marks[name]
        (place,) = mark.geometry.coords
        assert np.abs(in_world(np.array([place]), area)[0] - pose[:3, 3]).max() < 1e-3
        data = {datum.name: datum.value for datum in mark.extended_data.elements}
        assert data["height_reference"] == "takeoff"
        assert float(data["height_m"]) == place[2] == mark.view.altitude
        assert mark.view.altitude_mode.value == "relativeToGround"
        heading, tilt = np.deg2rad([mark.view.heading, mark.view.tilt])
        axis = [np.sin(heading) * np.sin(tilt), np.cos(heading) * np.sin(tilt), -np.cos(tilt)]
        assert np.abs(axis - pose[:3, 2]).max() < 1e-5


def test_nvm_is_read_by_kapture(
    exports: Path, truth: dict[str, np.ndarray], tmp_path: Path
) -> None:
    """kapture's importer reads the poses, points and measurements of the NVM file."""
    kapture = reader("kapture")
    script = Path(sys.executable).parent / "kapture_import_nvm.py"
    if not script.is_file():
        pytest.skip("this version of kapture comes without kapture_import_nvm.py")
    words = ["-i", str(exports / "nvm" / "reconstruction.nvm")]
    words += ["-im", str(exports / "nerfstudio" / "images"), "-o", str(tmp_path / "imported")]
    words += ["--add-reconstruction", "--image_transfer", "skip"]
    done = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    found = reader("kapture.io.csv").kapture_from_dir(str(tmp_path / "imported"))
    names = {name: (stamp, sensor) for stamp, sensor, name in kapture.flatten(found.records_camera)}
    assert names.keys() == truth.keys()
    for name, (stamp, sensor) in names.items():
        pose = found.trajectories[stamp, sensor].inverse()
        rotation = Rotation.from_quat(np.roll(pose.r_raw, -1)).as_matrix()
        assert np.abs(rotation - truth[name][:3, :3]).max() < 1e-6
        assert np.abs(pose.t.ravel() - truth[name][:3, 3]).max() < 1e-6
    ours = read_nvm(exports / "nvm" / "reconstruction.nvm")
    assert np.abs(np.asarray(found.points3d)[:, :3] - ours.xyz).max() < 1e-6
    seen = [pair for of_point in found.observations.values() for pair in of_point["sift"]]
    assert len(seen) == len(ours.point_idx)


def test_measurements_in_nvm_fit_its_points(exports: Path) -> None:
    """NVM measurements are undistorted and relative to the centre: f x/z and f y/z."""
    found = read_nvm(exports / "nvm" / "reconstruction.nvm")
    assert not found.distortion.any()
    is_map = np.array([not name.startswith("again/") for name in found.names])
    assert found.focal_px[~is_map].tolist() == [210.5] * 4  # the mean of 210 and 211
    mine = is_map[found.image_idx]
    rotations, centers = found.poses.rotations, found.poses.centers
    image_idx = found.image_idx[mine]
    rays = found.xyz[found.point_idx[mine]] - centers[image_idx]
    rays = np.einsum("nij,nj->ni", rotations[image_idx], rays)
    projected = found.focal_px[image_idx, None] * rays[:, :2] / rays[:, 2:]
    miss = np.linalg.norm(projected - found.offsets_px[mine], axis=1)
    assert 0.05 < np.median(miss) < 1.0


def test_each_folder_says_what_it_holds(exports: Path, area: Path) -> None:
    """export.json gives units, origin, sequences with roles, and the stages used."""
    origin = json.loads((area / "3-geo" / "geo.json").read_text())["origin"]
    stages = {"1-frames", "2-model", "3-geo", "4-eval/again"}
    # The short flight looks along the ground, whose height its map does not tell.
    assert not (exports / "geotiff").exists()
    for name in {*FORMATS} - {"all", "geotiff"}:
        record = json.loads((exports / name / "export.json").read_text())
        assert (record["format"], record["units"], record["version"]) == (name, "m", 1)
        assert record["origin"] == origin
        assert record["sequences"]["again"] == {"frames": 4, "role": "evaluation"}
        assert record["sequences"]["flight1"]["role"] == "mapping"
        assert record["made_of"].keys() == stages


def test_an_export_touches_nothing_of_the_area(area: Path, tmp_path: Path) -> None:
    """Exporting leaves every file of the area unchanged."""

    def fingerprints() -> dict[str, str]:
        return {
            str(path): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(area.rglob("*"))
            if path.is_file()
        }

    before = fingerprints()
    assert run("all", tmp_path / "out", area).exit_code == 0
    assert fingerprints() == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_failed_frame_is_nowhere_and_a_dense_one_only_where_it_was_asked_for(
    area: Path, exports: Path, tmp_path: Path
) -> None:
    """Failed frames are never exported, and tracked frames only with --all-frames."""
    text = "".join(
        path.read_text() for path in exports.rglob("*") if path.suffix in (".txt", ".json", ".kml")
    )
    assert "again/000003.jpg" in text
    assert "again/000004.jpg" not in text
    assert "again/000005.jpg" not in text
    done = run("geojson", tmp_path / "out", area, "--all-frames", "--sequence", "again")
    assert done.exit_code == 0, done.output
    text = (tmp_path / "out" / "frames.geojson").read_text()
    assert "again/000004.jpg" in text
    assert "again/000005.jpg" not in text
    assert "flight1" not in text


def test_a_colmap_model_holds_the_map_whole_whatever_is_chosen(area: Path, tmp_path: Path) -> None:
    """A COLMAP export contains the whole map whichever sequences are chosen."""
    for names, count in ((["again"], 4), (["flight1"], 0)):
        target = tmp_path / names[0]
        words = [word for name in names for word in ("--sequence", name)]
        assert run("colmap", target, area, *words).exit_code == 0
        found = pycolmap.Reconstruction(str(target / "sparse" / "0"))
        source = pycolmap.Reconstruction(str(area / "3-geo"))
        assert found.num_images() == source.num_images() + count
        for image in found.images.values():
            assert (target / "images" / image.name).is_file()


def test_without_a_place_everything_says_that_it_is_no_metres(
    area_without_place: Path, tmp_path: Path
) -> None:
    """Without georegistration, GeoJSON and KML are omitted and other formats state model units."""
    done = run("all", tmp_path / "out", area_without_place, "--no-images")
    assert done.exit_code == 0, done.output
    told = " ".join(done.output.split())
    assert "lengths are in model units, not metres" in told
    assert "geojson is left out: it needs a georegistered map" in told
    out = tmp_path / "out"
    written = {path.name for path in out.iterdir() if path.is_dir()}
    assert written == {*FORMATS} - {"geojson", "kml", "geotiff", "all"}
    for name in written:
        record = json.loads((out / name / "export.json").read_text())
        assert record["units"] == "model"
        assert record["origin"] is None
    for path in (*(out / "tum").glob("*.txt"), *(out / "kapture" / "sensors").glob("*.txt")):
        assert (
            "# units: model (COLMAP's own origin, axes and unit; not metres)\n" in path.read_text()
        )
    assert json.loads((out / "nerfstudio" / "transforms.json").read_text())["units"] == "model"
    for name in ("geojson", "kml"):
        done = run(name, tmp_path / name, area_without_place)
        assert done.exit_code == 1
        assert "needs a georegistered map; run spn-data georegister first" in done.output
        assert not (tmp_path / name).exists()


def test_a_target_is_refused_unless_it_is_free_or_an_earlier_export(
    area: Path, tmp_path: Path
) -> None:
    """Only new folders and earlier exports (with --overwrite) are accepted as target."""
    target = tmp_path / "out"
    target.mkdir()
    assert run("tum", target, area).exit_code == 0
    done = run("kml", target, area)
    assert done.exit_code == 1
    assert "already contains an export; use --overwrite to replace it" in done.output
    assert run("kml", target, area, "--overwrite").exit_code == 0
    assert sorted(path.name for path in target.iterdir()) == ["export.json", "frames.kml"]
    assert run("all", target, area, "--overwrite", "--no-images").exit_code == 0
    assert run("tum", target, area, "--overwrite").exit_code == 0
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    done = run("tum", mine, area, "--overwrite")
    assert done.exit_code == 1
    assert "contains other files" in done.output
    assert (mine / "thesis.txt").read_text() == "years of work"
    done = run("tum", mine / "thesis.txt", area, "--overwrite")
    assert "is not a folder" in done.output
    for inside in (area, area / "3-geo", area / "3-geo" / "new", area / "4-eval" / "new"):
        done = run("tum", inside, area, "--overwrite")
        assert done.exit_code == 1
        assert "is part of the area" in done.output


def test_what_can_not_be_exported_is_said(area: Path, tmp_path: Path) -> None:
    """Unknown sequences, tracked frames in NVM, and a missing area are refused."""
    done = run("tum", tmp_path / "out", area, "--sequence", "../../etc")
    assert "there is no sequence '../../etc'; the area has: again, flight1" in done.output
    done = run("nvm", tmp_path / "out", area, "--all-frames")
    assert "lists images, but frames added by --all-frames" in done.output
    done = run("tum", tmp_path / "out", tmp_path / "no-area")
    assert done.exit_code == 1
    assert not (tmp_path / "out").exists()


def test_an_area_without_poses_is_refused(area: Path, tmp_path: Path) -> None:
    """An evaluation sequence without any registered frame is refused."""
    root = tmp_path / "area"
    shutil.copytree(area, root)
    path = root / EVALUATION / "again" / POSES
    labels = read_labels(path)
    nothing = Poses(np.full((6, 3), np.nan), np.full((6, 4), np.nan))
    failed = {"status": np.full(6, "failed"), "poses": nothing}
    write_labels(path, Labels(**{**vars(labels), **failed}))
    done = run("tum", tmp_path / "out", root, "--sequence", "again")
    assert done.exit_code == 1
    assert "no frame of again has a pose" in done.output


def one_frame(reference: HeightReference, center: np.ndarray) -> ExportedFrames:
    """Return one level camera that looks north."""
    labels = Labels(
        names=np.array(["a&b/0.jpg"]),
        sequences=np.array(["a&b"]),
        cameras=np.array(["a"]),
        sources=np.array(["a.mp4"]),
        video_frame=np.zeros(1, np.int64),
        tracked=np.zeros(1, bool),
        time_s=np.zeros(1),
        status=np.array(["registered"]),
        reason=np.array([""]),
        poses=Poses(center[None], np.array([[np.sqrt(0.5), np.sqrt(0.5), 0, 0]])),
        covariance=np.zeros((1, 6, 6)),
        inliers=np.zeros(1, np.int64),
        coverage=np.zeros(1),
        error_px=np.zeros(1),
    )
    nothing = np.zeros(0, np.int64)
    return ExportedFrames(
        "m",
        GeoOrigin(49.0, 8.4, 100.0, reference),
        labels,
        np.zeros(1, bool),
        LabelObservations(nothing, nothing, np.zeros((0, 2))),
        MapPoints(nothing, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), nothing),
        {},
    )


@pytest.mark.parametrize(
    ("reference", "mode", "in_geojson"),
    [
        (HeightReference.ELLIPSOID, "clampToGround", True),
        (HeightReference.AMSL, "absolute", False),
        (HeightReference.TAKEOFF, "relativeToGround", False),
        (HeightReference.UNKNOWN, "clampToGround", False),
    ],
)
def test_heights_stand_where_their_reference_is_that_of_the_format(
    reference: HeightReference, mode: str, in_geojson: bool, tmp_path: Path
) -> None:
    """Heights become coordinates or absolute altitudes only if the reference fits the format."""
    frames = one_frame(reference, np.array([0, 0, 12.5]))
    write_geojson(tmp_path, frames)
    (feature,) = json.loads((tmp_path / "frames.geojson").read_text())["features"]
    assert feature["geometry"]["coordinates"] == ([8.4, 49, 112.5] if in_geojson else [8.4, 49])
    assert feature["properties"]["height_m"] == 112.5
    assert feature["properties"]["height_reference"] == reference.value
    assert (feature["properties"]["heading_deg"], feature["properties"]["pitch_deg"]) == (0, 0)
    write_kml(tmp_path, frames)
    text = (tmp_path / "frames.kml").read_text()
    assert f"<altitudeMode>{mode}</altitudeMode>" in text
    assert "<name>a&amp;b/0.jpg</name>" in text
    assert "8.4000000000,49.0000000000,112.5000" in text
    assert "<heading>0.0000</heading><tilt>90.0000</tilt>" in text


def test_times_stay_apart_and_in_order() -> None:
    """Equal timestamps are spaced by a microsecond in their order."""
    assert timestamps_us(np.array([0, 0.5, 0.5, 0.5, 0.500001, 2])) == [
        *(0, 500000, 500001, 500002, 500003, 2000000)
    ]


def option_rows() -> Iterator[tuple[str, str]]:
    text = (ROOT / "docs" / "exports.md").read_text(encoding="utf-8")
    yield from re.findall(r"^\| `(--[a-z-]+)` \|([^|]*)\|", text, re.MULTILINE)


def test_every_option_and_format_is_documented() -> None:
    """docs/exports.md has a row for each option and format, and no others."""
    command = main.commands["export"]
    given = [p for p in command.params if isinstance(p, click.Option)]
    flags = {p.opts[-1] for p in given if p.expose_value}
    assert {flag for flag, _ in option_rows()} == flags
    assert list(FORMATS) == [format_name.value for format_name in Format]
    table = (ROOT / "docs" / "exports.md").read_text(encoding="utf-8").split("## Formats")[1]
    rows = re.findall(r"^\| (`[^|]+`) \|", table.split("\n\n#")[0], re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`([a-z-]+)`", row)}
    assert {*FORMATS} - {"all"} <= named
