"""The two reconstructions compared by `reconstruct.py`: `python benchmarks/contestants.py WHO JOB.json`.

Each runs in a separate process, so that a native abort of one ends neither the other nor the comparison, and
its cost is that of the process. Modules are imported where they are used, because worker processes import
this file again.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from spn_data.capture.frames import Frames
    from spn_data.reconstruction.correspondences import FramesToMap
    from spn_data.work.timing import Stopwatch

OURS, PYCOLMAP = "ours", "pycolmap"
RESULT = "result.json"


@dataclass(frozen=True, kw_only=True)
class Job:
    """Task given to both. `work` is an existing, empty folder."""

    area: str
    work: str
    threads: int
    seed: int


@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of one of them: the folder with the model, or why there is none, with times and notes."""

    model: str | None
    failure: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def run_ours(frames: FramesToMap, job: Job, stopwatch: Stopwatch) -> tuple[Path, tuple[str, ...]]:
    """Run our reconstruction with its default options."""
    from spn_data.reconstruction.attempts import ReconstructOptions
    from spn_data.reconstruction.reconstruct import reconstruct

    options = ReconstructOptions(threads=job.threads, seed=job.seed)
    made = reconstruct(frames, Path(job.work), options, lambda *_: None, stopwatch)
    return made.refined.folder, (
        *made.attempts,
        f"{made.pairs_verified} of {made.pairs_tried} pairs fit",
    )


def run_pycolmap(
    frames: FramesToMap, chosen: Frames, job: Job, stopwatch: Stopwatch
) -> tuple[Path, tuple[str, ...]]:
    """Run pycolmap's pipeline as documented, with default options except for threads and seeds.

    It gets the same input as ours: frames, one camera per flight with the same initial intrinsics, masks.
    Video is matched sequentially, photos with a position spatially, other photos exhaustively.
    """
    import numpy as np

    from spn_data.colmap import pycolmap
    from spn_data.errors import StageError

    pycolmap.set_random_seed(job.seed)
    database, images = Path(job.work) / "database.db", str(frames.folder)
    names = np.array(frames.names)
    with stopwatch.step("features"):
        with pycolmap.Database.open(database) as native:
            camera_ids = {key: _add_camera(native, frames, key) for key in frames.lenses}
        extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads)
        for key, camera_id in camera_ids.items():
            for sequence in np.unique(frames.sequences[frames.cameras == key]).tolist():
                mine = (frames.cameras == key) & (frames.sequences == sequence)
                reader = pycolmap.ImageReaderOptions(existing_camera_id=camera_id)
                if sequence in frames.masks:
                    reader.camera_mask_path = str(frames.masks[sequence])
                pycolmap.extract_features(
                    database,
                    images,
                    names[mine].tolist(),
                    pycolmap.CameraMode.SINGLE,
                    reader,
                    extraction,
                )
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    photo = chosen.video_frame < 0
    located = photo & np.isfinite(frames.positions_m).all(axis=1)
    with stopwatch.step("matching"):
        how = []
        if not photo.all():
            how.append("match_sequential")
            pycolmap.match_sequential(database, matching, verification_options=verification)
        if located.any():
            how.append("match_spatial")
            _write_priors(database, frames, located)
            pycolmap.match_spatial(database, matching, verification_options=verification)
        if not how:
            how.append("match_exhaustive")
            pycolmap.match_exhaustive(database, matching, verification_options=verification)
    output = Path(job.work) / "models"
    output.mkdir()
    options = pycolmap.IncrementalPipelineOptions(num_threads=job.threads, random_seed=job.seed)
    with stopwatch.step("mapping"):
        models = pycolmap.incremental_mapping(database, images, output, options)
    if not models:
        raise StageError("incremental_mapping made no model")
    sizes = {i: model.num_reg_images() for i, model in models.items()}
    largest = max(sizes, key=lambda i: sizes[i])
    with pycolmap.Database.open(database) as native:
        fitting = sum(n > 0 for n in native.read_two_view_geometry_num_inliers()[1])
        pairs = f"{fitting} of {native.num_matched_image_pairs()} pairs fit"
    summary = f"{' and '.join(how)}; models of {', '.join(map(str, sorted(sizes.values())[::-1]))}"
    return output / str(largest), (summary, pairs)


def _add_camera(native: object, frames: FramesToMap, key: str) -> int:
    from spn_data.colmap.verify import native_camera

    lens = frames.lenses[key]
    return int(native.write_camera(native_camera(lens.camera, focal_is_known=lens.focal_is_known)))  # type: ignore[attr-defined]


def _write_priors(database: Path, frames: FramesToMap, located: object) -> None:
    """Replace the positions that extraction took from EXIF by ours."""
    from spn_data.colmap import pycolmap

    positions = dict(zip(frames.names, frames.positions_m, strict=True))
    use = dict(zip(frames.names, located, strict=True))  # type: ignore[call-overload]
    with pycolmap.Database.open(database) as native:
        native.clear_pose_priors()
        for image in native.read_all_images():
            if use[image.name]:
                native.write_pose_prior(
                    pycolmap.PosePrior(
                        corr_data_id=image.data_id,
                        position=positions[image.name],
                        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                    )
                )


def main(who: str, job: Job) -> None:
    """Run one of the two and write its result to the work folder."""
    from spn_data.area.area import Area
    from spn_data.area.names import FRAMES
    from spn_data.capture.frames import read_frames
    from spn_data.errors import StageError
    from spn_data.pipeline.model_stage import frames_to_map
    from spn_data.work.timing import Stopwatch

    area = Area(Path(job.area))
    frames = read_frames(area.folder(FRAMES) / "frames.csv")
    chosen = frames.select(frames.chosen)
    to_map = frames_to_map(area, chosen)
    stopwatch = Stopwatch()
    model: Path | None = None
    notes: tuple[str, ...] = ()
    failure = None
    try:
        if who == OURS:
            model, notes = run_ours(to_map, job, stopwatch)
        elif who == PYCOLMAP:
            model, notes = run_pycolmap(to_map, chosen, job, stopwatch)
        else:
            raise ValueError(f"unknown contestant {who!r}")
    except StageError as error:
        failure = str(error)
    result = Result(
        model=None if model is None else str(model),
        failure=failure,
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=notes,
    )
    (Path(job.work) / RESULT).write_text(json.dumps(asdict(result)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Job(**json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))))
