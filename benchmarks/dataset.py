"""Cost of writing a dataset: time, memory, file size, and whether memory grows with the number of frames.

    python benchmarks/dataset.py AREA [--frames 1000 10000] [--folder DIR] [--json OUT]

The mapping frames of AREA are read from their files, undistorted, reduced and written repeatedly, each time
with different noise (another part of one large field), until the requested number of frames is reached. Each
number of frames is measured in a separate process.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from process import run_measured

from spn_data.area.area import Area
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.geometry.rendering import PinholeRenderer, RenderingOptions, canonical_camera
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.inputs.frame_images import frame_images

_NOISE_SIGMA = 3.0  # grey levels
_MARGIN = 128  # pixels by which the field of noise is larger than an image
_GROUPS = {"train": Role.TRAIN, "validation": Role.VALIDATION, "test": Role.TEST}
_READS = 500


@dataclass(frozen=True)
class Cost:
    """Cost of one dataset. early_mb, late_mb : resident memory after 100 frames and after the last one."""

    frames: int
    points: int
    early_mb: float
    late_mb: float
    peak_mb: float  # of the whole process, including reading the map
    wall_s: float
    cpu_s: float
    write_s: float  # part of wall_s spent in the writer
    file_gb: float
    read_ms: float  # time to read a random image from a warm page cache


def write(area_folder: Path, target: Path, frames: int) -> Cost:
    """Write a dataset with `frames` frames, eight of ten for training, and measure the cost."""
    labelled = read_labelled_area(Area(area_folder))
    labels = labelled.mapping.select(np.flatnonzero(labelled.mapping.registered))
    seen = labelled.mapping_seen.select(np.flatnonzero(labelled.mapping.registered))
    target_camera = canonical_camera(list(labelled.cameras.values()), RenderingOptions())
    renderers = {
        key: PinholeRenderer(camera, target_camera) for key, camera in labelled.cameras.items()
    }
    rng = np.random.default_rng(0)
    noise: np.ndarray | None = None
    done = points = 0
    write_s = 0.0
    info = _info(labelled)
    early_mb = _resident_mb()
    begin, cpu = time.perf_counter(), time.process_time()
    with DatasetWriter(target, info, _GROUPS) as writer:
        while done < frames:
            for row, image in frame_images(Area(area_folder), labels):
                height, width = image.shape[:2]
                if noise is None:
                    field = rng.normal(0, _NOISE_SIGMA, (height + _MARGIN, width + _MARGIN, 3))
                    noise = np.round(field).astype(np.int16)
                y, x = rng.integers(0, _MARGIN, 2)
                part = noise[y : y + height, x : x + width]
                noisy = cv2.add(image, np.ascontiguousarray(part), dtype=cv2.CV_8U)
                renderer = renderers[str(labels.cameras[row])]
                ids, pixels = seen.of_frame(row)
                moved, is_seen = renderer.map_pixels(pixels)
                frame = DatasetFrame(
                    name=f"{done:07d}/{labels.names[row]}",
                    sequence=str(labels.sequences[row]),
                    time_s=float(labels.time_s[row]),
                    center=labels.poses.centers[row],
                    quat_wxyz=labels.poses.quats_wxyz[row],
                    intrinsics=target_camera.matrix,
                    covariance=labels.covariance[row],
                    image=cv2.cvtColor(renderer.render(noisy), cv2.COLOR_BGR2RGB),
                    point_ids=ids[is_seen],
                    point_pixels=moved[is_seen],
                    point_xyz=labelled.points.xyz[labelled.points.rows_of(ids[is_seen])],
                )
                before = time.perf_counter()
                writer.append(("train", "validation", "test")[max(0, done % 10 - 7)], frame)
                write_s += time.perf_counter() - before
                done, points = done + 1, points + int(is_seen.sum())
                if done == 100:
                    early_mb = _resident_mb()
                if done == frames:
                    break
        late_mb = _resident_mb()
        before = time.perf_counter()
    write_s += time.perf_counter() - before
    wall_s, cpu_s = time.perf_counter() - begin, time.process_time() - cpu
    return Cost(
        done,
        points,
        early_mb,
        late_mb,
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        wall_s,
        cpu_s,
        write_s,
        target.stat().st_size / 1e9,
        _read_ms(target),
    )


def _info(labelled: LabelledArea) -> DatasetInfo:
    return DatasetInfo(
        units=labelled.units,
        origin=labelled.origin,
        up_is_known=labelled.units == "m",
        camera=canonical_camera(list(labelled.cameras.values()), RenderingOptions()),
    )


def _read_ms(path: Path) -> float:
    with Dataset(path) as dataset:
        group = dataset.groups["train"]
        assert group.image_size is not None
        out = np.empty((*group.image_size[::-1], 3), np.uint8)
        rows = np.random.default_rng(0).integers(0, len(group), _READS)
        for row in rows:  # warm the page cache
            group.image(int(row), out)
        begin = time.perf_counter()
        for row in rows:
            group.image(int(row), out)
        return (time.perf_counter() - begin) / _READS * 1e3


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("area", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--folder", type=Path, help="where to write [default: a temporary folder]")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        cost = write(given.area, given.child, given.frames[0])
        given.child.with_suffix(".json").write_text(json.dumps(asdict(cost)))
        return
    costs = []
    print(
        "frames    points  MB at 100  MB at end  peak MB  wall s  of it writing  file GB  read ms"
    )
    for frames in given.frames:
        with tempfile.TemporaryDirectory(dir=given.folder) as folder:
            target, log = Path(folder) / "dataset.h5", Path(folder) / "log"
            words = [str(given.area), "--frames", str(frames), "--child", str(target)]
            used = run_measured([sys.executable, __file__, *words], threads=1, log=log)
            if used.exit_code != 0:
                sys.exit(f"{frames} frames: exit code {used.exit_code}\n{log.read_text()}")
            cost = Cost(**json.loads(target.with_suffix(".json").read_text()))
        costs.append(cost)
        print(
            f"{cost.frames:6d} {cost.points:9d} {cost.early_mb:10.0f} {cost.late_mb:10.0f} "
            f"{cost.peak_mb:8.0f} {cost.wall_s:7.1f} {cost.write_s:14.1f} {cost.file_gb:8.2f} "
            f"{cost.read_ms:8.2f}",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps([asdict(cost) for cost in costs], indent=1) + "\n")


if __name__ == "__main__":
    main()
