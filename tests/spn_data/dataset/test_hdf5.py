"""Tests of dataset.h5: round trips, constant memory, and rejection of damaged files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import COLUMNS, OFFSET, POINTS, DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.rotations import canonical_quats

ROOT = Path(__file__).resolve().parents[3]
CAMERA = Camera("SIMPLE_PINHOLE", 48, 27, np.array([40.0, 24.0, 13.5]))
INFO = DatasetInfo(
    units="m",
    origin=GeoOrigin(-33.86, 151.2, 12.5, HeightReference.TAKEOFF),
    up_is_known=True,
    camera=CAMERA,
    optimistic=True,
    split={"policy": "blocks", "guard_s": 2.0},
    fingerprints={"3-geo": "0123456789abcdef"},
    notes=("same flight as training: optimistic",),
)
GROUPS = {"train": Role.TRAIN, "validation": Role.VALIDATION, "low": Role.TEST}
PART = np.arange(27 * 48).reshape(27, 48) % 7 > 0  # pixels seen by a narrow camera


def frame(group: str, k: int) -> DatasetFrame:
    """Return frame k of a group, with distinct values; some frames of `low` are partly masked."""
    rng = np.random.default_rng([k, *group.encode()])
    seen = k % 5
    return DatasetFrame(
        name=f"flight {group}/{k:06d}.jpg",
        sequence=f"flight {group}",
        time_s=0.1 * k,
        center=rng.normal(size=3) * 30,
        quat_wxyz=canonical_quats(rng.normal(size=4)),
        covariance=rng.normal(size=(6, 6)),
        intrinsics=CAMERA.matrix,
        tracked=bool(k % 2),
        stratum=("high", "medium", "low", "")[k % 4],
        image=rng.integers(0, 256, (27, 48, 3)).astype(np.uint8),
        valid=PART if group == "low" and k % 3 == 0 else None,
        point_ids=rng.integers(1, 2**40, seen),
        point_pixels=rng.uniform(0, 27, (seen, 2)),
        point_xyz=rng.normal(size=(seen, 3)),
    )


def write(path: Path, frames: list[tuple[str, DatasetFrame]]) -> None:
    with DatasetWriter(path, INFO, GROUPS) as writer:
        for group, one in frames:
            writer.append(group, one)


COUNTS = {"train": 150, "validation": 3, "low": 70}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a data set whose groups are appended in turn."""
    path = tmp_path_factory.mktemp("dataset") / "dataset.h5"
    with DatasetWriter(path, INFO, GROUPS) as writer:
        for k in range(max(COUNTS.values())):
            for group, count in COUNTS.items():
                if k < count:
                    writer.append(group, frame(group, k))
    return path


def test_what_is_written_comes_back(written):
    """Every value of every frame is read back exactly, in the order of writing."""
    with Dataset(written) as dataset:
        assert list(dataset.groups) == sorted(GROUPS)
        for name, group in dataset.groups.items():
            assert group.role is GROUPS[name]
            assert len(group) == COUNTS[name]
            assert group.image_size == (48, 27)
            for k in range(len(group)):
                wanted = frame(name, k)
                assert group.names[k] == wanted.name
                assert group.sequences[k] == wanted.sequence
                assert group.strata[k] == wanted.stratum
                assert group.time_s[k] == wanted.time_s
                assert group.tracked[k] == wanted.tracked
                assert (group.poses.centers[k] == wanted.center).all()
                assert (group.poses.quats_wxyz[k] == wanted.quat_wxyz).all()
                assert (group.covariance[k] == wanted.covariance).all()
                assert (group.intrinsics[k] == wanted.intrinsics).all()
                assert (group.image(k) == wanted.image).all()
                points = group.points(k)
                assert (points.ids == wanted.point_ids).all()
                assert (points.pixels == wanted.point_pixels.astype(np.float32)).all()
                assert (points.xyz == wanted.point_xyz).all()
        assert {name: g.role for name, g in dataset.groups.items()}["low"] is Role.TEST


def test_what_holds_for_the_whole_comes_back(written):
    """Units, origin, camera, split, fingerprints and notes are read back from the root's attributes."""
    with Dataset(written) as dataset:
        found = dataset.info
    assert found.to_attributes() == INFO.to_attributes()
    assert found.origin == INFO.origin
    assert found.camera is not None
    assert found.camera.params.tolist() == CAMERA.params.tolist()


def test_a_world_without_a_place_has_none():
    """An unknown origin is read back as none, not as latitude 0."""
    bare = replace(INFO, origin=None, up_is_known=False, camera=None, units="model")
    found = DatasetInfo.from_attributes(bare.to_attributes())
    assert found.origin is None
    assert found.camera is None
    assert not found.up_is_known
    assert np.isnan(bare.to_attributes()["origin_lat_deg"])


def test_masks_are_stored_once_a_camera_and_only_where_needed(written):
    """Frames without invalid pixels have no mask; frames of one camera share theirs."""
    with Dataset(written) as dataset:
        assert dataset.groups["train"].all_valid
        assert dataset.groups["train"].valid(5) is None
        low = dataset.groups["low"]
        assert not low.all_valid
        assert low.valid(1) is None
        assert (low.valid(3) == PART).all()
    with h5py.File(written) as file:
        assert "masks" not in file["train"]
        assert file["low/masks"].shape == (1, 27, 48)


def test_only_training_groups_give_points_to_learn_from(written):
    """Points of validation and test groups are refused for training."""
    with Dataset(written) as dataset:
        assert len(dataset.groups["train"].training_points(4).ids) == 4
        for name in ("validation", "low"):
            group = dataset.groups[name]
            assert not group.points_for_training
            with pytest.raises(InputError, match="not for training"):
                group.training_points(0)


def test_images_are_stored_one_a_chunk_as_they_are(written):
    """Images are stored uncompressed, one per chunk, and can be read into a buffer."""
    with h5py.File(written) as file:
        images = file["train/images"]
        assert images.chunks == (1, 27, 48, 3)
        assert images.compression is None
    with Dataset(written) as dataset:
        out = np.zeros((27, 48, 3), np.uint8)
        assert dataset.groups["train"].image(-1, out) is out
        assert (out == frame("train", 149).image).all()


def test_the_same_frames_make_the_same_bytes(tmp_path):
    """Writing the same frames twice gives identical bytes, without time stamps."""
    for name in ("a.h5", "b.h5"):
        with DatasetWriter(tmp_path / name, INFO, GROUPS) as writer:
            for k in range(70):
                writer.append("train", frame("train", k))
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_poses_alone_make_a_data_set_too(tmp_path):
    """A data set without images is valid; asking for an image raises an error."""
    path = tmp_path / "poses.h5"
    with DatasetWriter(path, replace(INFO, has_images=False), {"train": Role.TRAIN}) as writer:
        nan = np.full((3, 3), np.nan)
        writer.append("train", replace(frame("train", 0), image=None, intrinsics=nan))
    with Dataset(path) as dataset:
        train = dataset.groups["train"]
        assert not dataset.info.has_images
        assert train.image_size is None
        assert np.isnan(train.intrinsics).all()
        with pytest.raises(InputError, match="contains no images"):
            train.image(0)


def test_groups_without_frames_are_there(tmp_path):
    """A group without frames is kept as an empty group."""
    with DatasetWriter(tmp_path / "d.h5", INFO, GROUPS):
        pass
    with Dataset(tmp_path / "d.h5") as dataset:
        assert [len(g) for g in dataset.groups.values()] == [0, 0, 0]
        assert dataset.groups["low"].names.tolist() == []
        assert len(dataset.groups["low"].poses) == 0


def test_memory_does_not_grow_with_the_frames(tmp_path):
    """Memory grows by less than 60 MB between 10 and 400 frames of 1.5 MB."""
    code = """
import resource, sys
import numpy as np
from pathlib import Path
from tests.spn_data.dataset.test_hdf5 import INFO, frame, replace
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.dataset.hdf5_schema import Role
image = np.random.default_rng(0).integers(0, 256, (500, 1000, 3)).astype(np.uint8)
one = replace(frame("train", 4), image=image)
with DatasetWriter(Path(sys.argv[1]), INFO, {"train": Role.TRAIN}) as writer:
    for k in range(400):
        writer.append("train", replace(one, name=f"s/{k}.jpg", image=image.copy()))
        if k in (9, 399):
            print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "big.h5")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    early_kb, late_kb = map(int, done.stdout.split())
    assert (late_kb - early_kb) / 1024 < 40 * 1.5
    assert (tmp_path / "big.h5").stat().st_size > 600e6


def test_an_error_leaves_no_file(tmp_path):
    """After an error, no unfinished file remains and the previous file is kept."""
    path = tmp_path / "dataset.h5"
    path.write_text("before")
    with pytest.raises(KeyError, match="no such"):
        write(path, [("train", frame("train", 0)), ("no such", frame("train", 1))])
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["dataset.h5"]


def test_a_killed_run_leaves_what_the_next_replaces(tmp_path):
    """A killed writer leaves only a .part file, which the next run replaces."""
    path = tmp_path / "dataset.h5"
    code = (
        "import os, sys; from pathlib import Path; from tests.spn_data.dataset.test_hdf5 import *\n"
        "writer = DatasetWriter(Path(sys.argv[1]), INFO, GROUPS)\n"
        "for k in range(100): writer.append('train', frame('train', k))\n"
        "os.kill(os.getpid(), 9)"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(path)], cwd=ROOT, timeout=60, check=False)
    assert ran.returncode == -9
    assert os.listdir(tmp_path) == ["dataset.h5.part"]
    with DatasetWriter(path, INFO, GROUPS) as writer:
        writer.append("train", frame("train", 0))
    assert os.listdir(tmp_path) == ["dataset.h5"]


def test_a_full_disk_is_reported(tmp_path):
    """A full disk gives a one-line error and leaves no file."""
    code = (
        "import signal, resource, sys; from pathlib import Path\n"
        "from tests.spn_data.dataset.test_hdf5 import *\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "from spn_data.errors import StageError\n"
        "try:\n"
        "    with DatasetWriter(Path(sys.argv[1]), INFO, GROUPS) as writer:\n"
        "        for k in range(300): writer.append('train', frame('train', k))\n"
        "except StageError as error:\n"
        "    print(error)\n"
    )
    path = tmp_path / "dataset.h5"
    ran = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ran.stdout.strip() == f"{path} cannot be written: File too large", ran.stderr
    assert ran.returncode == 0
    assert os.listdir(tmp_path) == []


def test_a_missing_folder_is_reported(tmp_path):
    """A missing output folder gives a StageError, not an HDF5 traceback."""
    from spn_data.errors import StageError

    with pytest.raises(StageError, match=r"cannot be written: No such file"):
        DatasetWriter(tmp_path / "no" / "dataset.h5", INFO, GROUPS)


def test_two_frames_of_one_name_are_refused(tmp_path):
    """A frame name used in two groups is refused."""
    one = frame("train", 0)
    with pytest.raises(InputError, match="two frames are named"):
        write(tmp_path / "d.h5", [("train", one), ("validation", one)])


def test_images_of_two_sizes_are_refused(tmp_path):
    """Images of different sizes within a group are refused."""
    other = replace(
        frame("train", 1), image=np.zeros((20, 48, 3), np.uint8), point_pixels=np.zeros((1, 2))
    )
    with pytest.raises(
        InputError, match="is 48x20, but the images before it in group train are 48x27"
    ):
        write(tmp_path / "d.h5", [("train", frame("train", 0)), ("train", other)])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"center": np.array([1, np.nan, 2])}, "has no pose"),
        ({"quat_wxyz": np.array([-1.0, 0, 0, 0])}, "not canonical"),
        ({"quat_wxyz": np.array([1.1, 0, 0, 0])}, "not canonical"),
        ({"stratum": "middling"}, "not a stratum"),
        ({"image": None}, "has no image"),
        ({"image": np.zeros((27, 48, 3))}, "uint8"),
        ({"valid": np.ones((3, 3), bool)}, "mask and image differ in shape"),
        ({"point_pixels": np.full((2, 2), 48.5)}, "outside the image"),
        ({"point_ids": np.zeros(9, np.int64)}, "differ in length"),
    ],
)
def test_a_frame_that_breaks_the_format_is_our_mistake(tmp_path, changes, message):
    """A frame that violates the schema raises ValueError."""
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "d.h5", [("train", replace(frame("train", 2), **changes))])


def damage(path: Path, change: str) -> None:
    """Damage a data set in one way."""
    with h5py.File(path, "r+") as file:
        train = file["train"]
        if change == "version":
            file.attrs["version"] = 3
        elif change == "version without offset":
            file.attrs["version"] = 2
        elif change == "offset without version":
            file.attrs["offset_x"] = 500_000.0
        elif change == "format":
            file.attrs["format"] = np.bytes_("something else")
        elif change == "no units":
            del file.attrs["units"]
        elif change == "camera":
            file.attrs["camera"] = np.bytes_('{"model": "PINHOLE", "width": 1e99}')
        elif change == "text of variable length":
            file.attrs["units"] = "m"
        elif change == "role":
            train.attrs["role"] = np.bytes_("spare")
        elif change == "test points for training":
            file["low/points"].attrs["for_training"] = 1
        elif change == "no poses":
            del train["centers"]
        elif change == "row missing":
            train["time_s"].resize(149, axis=0)
        elif change == "other type":
            del train["centers"]
            train.create_dataset("centers", data=np.zeros((150, 3), "f4"), chunks=(150, 3))
        elif change == "claims what is not there":
            for name in COLUMNS:
                train[name].resize(10**9, axis=0)
            train["points/offsets"].resize(10**9 + 1, axis=0)
        elif change == "soft link":
            del train["centers"]
            train["centers"] = h5py.SoftLink("/low/centers")
        elif change == "link to another file":
            del train["images"]
            train["images"] = h5py.ExternalLink("/etc/passwd", "/images")
        elif change == "bytes of another file":
            del train["time_s"]
            train.create_dataset("time_s", (150,), "f8", external=[("/etc/passwd", 0, 1200)])
        elif change == "virtual":
            layout = h5py.VirtualLayout((150,), "f8")
            layout[:70] = h5py.VirtualSource("other.h5", "low/time_s", (70,))
            del train["time_s"]
            train.create_virtual_dataset("time_s", layout)
        elif change == "a group's place":
            del train["points"]
            train["points"] = np.zeros(3)
        elif change == "offsets":
            train["points/offsets"][3] = 10**6
        elif change == "pose":
            train["quats_wxyz"][7] = np.nan
        elif change == "mask":
            file["low/mask_idx"][3] = 5
        elif change == "no text":
            train["names"][0] = b"\xff\xfe"
        else:
            raise AssertionError(change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("version", "has format version 3, this program reads 1 and 2"),
        ("version without offset", "its version and its offset contradict each other"),
        ("offset without version", "its version and its offset contradict each other"),
        ("format", "is not a data set of this program"),
        ("no units", "its attributes cannot be read"),
        ("camera", "its attributes cannot be read"),
        ("role", "group train cannot be read"),
        ("test points for training", "marked for training"),
        ("no poses", "group train cannot be read"),
        ("row missing", "group train cannot be read"),
        ("other type", "group train cannot be read"),
        ("claims what is not there", "is truncated"),
        ("soft link", "is a link"),
        ("link to another file", "is a link"),
        ("bytes of another file", "unsupported storage layout or filter"),
        ("virtual", "unsupported storage layout or filter"),
        ("a group's place", "points is not a Group"),
        ("offsets", "point offsets of group train are damaged"),
        ("pose", "contains an invalid pose"),
        ("mask", "masks that do not exist"),
        ("no text", "names of train cannot be read"),
        ("text of variable length", "units is not a single number or text"),
    ],
)
def test_a_damaged_or_hostile_file_is_refused(written, tmp_path, change, message):
    """Damaged files, false sizes and links to other files are refused with the reason."""
    path = tmp_path / "damaged.h5"
    shutil.copy(written, path)
    damage(path, change)
    with pytest.raises(FormatError, match=message) as caught:
        read_all(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def read_all(path: Path) -> None:
    with Dataset(path) as dataset:
        for group in dataset.groups.values():
            for name in COLUMNS.keys() - {"centers", "quats_wxyz", "mask_idx", "dense"} | {
                "tracked"
            }:
                getattr(group, name)
            assert len(group.poses) == len(group)
            for k in range(len(group)):
                group.points(k)
                group.valid(k)
                if dataset.info.has_images:
                    group.image(k)


def test_what_is_no_hdf5_file_is_refused(tmp_path):
    """A text, empty or missing file and a folder are refused."""
    (tmp_path / "text.h5").write_text("hello")
    (tmp_path / "empty.h5").touch()
    for name in ("text.h5", "empty.h5"):
        with pytest.raises(FormatError, match="is not a data set of this program"):
            Dataset(tmp_path / name)
    with pytest.raises(InputError, match="is not a file"):
        Dataset(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        Dataset(tmp_path / "nothing.h5")


FUZZ = """
import random, sys
from pathlib import Path
from tests.spn_data.dataset.test_hdf5 import FormatError, read_all
source, target, first, last = Path(sys.argv[1]).read_bytes(), Path(sys.argv[2]), *map(int, sys.argv[3:])
refused = 0
for seed in range(first, last):
    rng, data = random.Random(seed), bytearray(source)
    if seed % 4 == 0:
        del data[rng.randrange(len(data)):]
    for _ in range(rng.choice((1, 5, 40)) if seed % 4 else 0):
        # Most of a file are pixels: change the bytes between them, in the first and last part.
        where = rng.randrange(min(len(data), 60_000))
        data[where if rng.random() < 0.7 else -1 - where] = rng.randrange(256)
    target.write_bytes(data)
    try:
        read_all(target)
    except FormatError:
        refused += 1
print(refused)
"""


def test_random_damage_is_refused_or_harmless(written, tmp_path):
    """A truncated or randomly changed file is read or refused without crashing."""
    done = subprocess.run(
        [sys.executable, "-c", FUZZ, str(written), str(tmp_path / "d.h5"), "0", "60"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 15


def test_the_documented_schema_is_the_one_written(written):
    """docs/dataset.md describes exactly the datasets and attributes that are written."""
    text = (ROOT / "docs" / "dataset.md").read_text(encoding="utf-8")
    rows = {
        name
        for line in text.splitlines()
        if line.startswith("| `")
        for name in line.split("|")[1].replace("`", " ").replace(",", " ").split()
    }
    with h5py.File(written) as file:
        wanted = set(file.attrs) | set(COLUMNS) | {f"points/{n}" for n in (*POINTS, "offsets")}
        wanted |= {*OFFSET, "role", "all_valid", "for_training", "images", "masks"}
        assert set(file["low"]) == set(COLUMNS) | {"images", "masks", "points"}
        assert set(file["low/points"]) == {*POINTS, "offsets"}
        assert all(file["low"][name].attrs["description"] for name in (*COLUMNS, "images", "masks"))
    assert rows == wanted


@pytest.mark.slow
def test_the_benchmark_measures_what_it_writes(finished_area, tmp_path):
    """benchmarks/dataset.py writes the requested numbers of frames and leaves only its figures."""
    program, figures = ROOT / "benchmarks" / "dataset.py", tmp_path / "figures.json"
    words = [str(finished_area), "--frames", "30", "60", "--folder", str(tmp_path)]
    subprocess.run(
        [sys.executable, str(program), *words, "--json", str(figures)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
        timeout=120,
        capture_output=True,
    )
    few, many = json.loads(figures.read_text())
    assert (few["frames"], many["frames"]) == (30, 60)
    assert many["points"] > few["points"] > 0
    assert many["file_gb"] * 1e9 > 60 * 480 * 270 * 3
    assert many["late_mb"] < few["late_mb"] + 60
    assert os.listdir(tmp_path) == ["figures.json"]
