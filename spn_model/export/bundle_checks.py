"""What a bundle loses against the network that it was made of: parity, and errors in 8 bits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.work.timing import Progress
from spn_model.evaluation.validation import spread_rows
from spn_model.export.graphs import Deployment, reference
from spn_model.models.checkpoint import Checkpoint
from spn_model.onboard.bundle import FLOAT32, INT8
from spn_model.onboard.localizer import Localizer

_LEAST_POSES = 8  # with fewer of them outputs alone are compared


@dataclass(frozen=True, kw_only=True)
class BundleOptions:
    """What goes into a bundle, and how it is checked."""

    int8: bool = True  # the 8-bit graph as well
    calibration_images: int = 64  # training images that the ranges of 8-bit activations come from
    parity_images: int = 16  # on which onnxruntime is compared with PyTorch
    loss_images: int = 500  # of each evaluation sequence, on which both graphs are judged, at most
    output_tolerance: float = (
        1e-4  # largest difference of an output, as a share of its largest value
    )
    # difference that a quarter of the poses stay below, in their own standard deviations
    pose_tolerance: float = 0.01


@dataclass(frozen=True, kw_only=True)
class Parity:
    """PyTorch against onnxruntime on real images.

    output : largest difference, as a share of an output's largest value. Medians over images that both have
    a pose of: position in the world's unit, rotation_deg, sigmas (the larger of both, by the pose's own
    standard deviations). largest_sigmas, and disagree, the images of which only one has a pose: where a
    network is unsure, RANSAC may take rounding for a reason to choose otherwise.
    """

    images: int
    output: float
    position: float
    rotation_deg: float
    sigmas: float
    largest_sigmas: float
    disagree: int


@dataclass(frozen=True, kw_only=True)
class GroupErrors:
    """Medians of one graph over images of a group; one without a pose is infinitely wrong."""

    group: str
    precision: str
    images: int
    located: int
    position: float
    rotation_deg: float


def judged_groups(data: Dataset) -> list[DatasetGroup]:
    """Test groups with frames; without one, the validation groups."""
    for role in (Role.TEST, Role.VALIDATION, Role.TRAIN):
        if found := [group for group in data.of_role(role) if len(group)]:
            return found
    return []


def compare_with_pytorch(
    folder: Path,
    checkpoint: Checkpoint,
    deployed: Deployment,
    data: Dataset,
    options: BundleOptions,
    progress: Progress,
) -> Parity:
    """Compare, or raise GeometryError."""
    localizer = Localizer(folder)
    groups = judged_groups(data)
    each = max(1, options.parity_images // len(groups))
    chosen = [(group, int(row)) for group in groups for row in spread_rows(len(group), each)]
    output, disagree, apart = 0.0, 0, []
    for done, (group, row) in enumerate(chosen):
        progress("parity", done, len(chosen))
        image, matrix = group.image(row), group.intrinsics[row]
        sized = deployed.sized(image)
        outputs = localizer.run(sized)
        for found, wanted in zip(outputs, reference(deployed, sized), strict=True):
            size = max(float(np.abs(wanted).max()), 1e-6)
            output = max(output, float(np.abs(found - wanted).max()) / size)
        # Its own poses come to be by another path than the bundle's.
        own = checkpoint.model.estimate(image[None], matrix[None])
        told = localizer.decode(outputs, _scaled(matrix, deployed, image))
        disagree += bool(told.reason) != bool(own.reasons[0])
        if not told.reason and not own.reasons[0]:
            position, rotation_deg = (float(v[0]) for v in pose_errors(told.poses, own.poses))
            variance = np.diag(own.covariance[0])
            stated_m, stated = np.sqrt([variance[:3].sum(), variance[3:].sum()])
            sigmas = max(position / stated_m, math.radians(rotation_deg) / stated)
            apart.append((position, rotation_deg, sigmas))
    progress("parity", len(chosen), len(chosen))
    # A network that finds no pose at all has none that could differ.
    differences = np.array(apart or [(0.0, 0.0, 0.0)])
    position, rotation_deg, sigmas = (float(v) for v in np.median(differences, axis=0))
    if not output <= options.output_tolerance:
        raise GeometryError(
            f"the exported graph computes something else than the network: an output differs by "
            f"{output:.1e} of its largest value, {options.output_tolerance:.0e} is allowed"
        )
    # A graph that computes or is decoded otherwise moves every pose; rounding moves those of which RANSAC is
    # unsure, and of a hardly trained network these are many.
    alike = float(np.quantile(differences[:, 2], 0.25))
    is_known = len(apart) >= min(_LEAST_POSES, len(chosen))
    if (is_known and not alike <= options.pose_tolerance) or disagree > len(chosen) / 2:
        raise GeometryError(
            f"the bundle gives other poses than the network: three quarters of them differ by more than "
            f"{alike:.1e} of their standard deviations, and "
            f"{disagree} of {len(chosen)} images have a pose by one of the two alone"
        )
    return Parity(
        images=len(chosen),
        output=output,
        position=position,
        rotation_deg=rotation_deg,
        sigmas=sigmas,
        largest_sigmas=float(differences[:, 2].max()),
        disagree=disagree,
    )


def _scaled(matrix: np.ndarray, deployed: Deployment, image: np.ndarray) -> np.ndarray:
    """K of the data set's image as the graph takes it."""
    shrunk = np.diag([deployed.size[0] / image.shape[1], deployed.size[1] / image.shape[0], 1.0])
    scaled: np.ndarray = shrunk @ matrix
    return scaled


def measure_errors(
    folder: Path, deployed: Deployment, data: Dataset, options: BundleOptions, progress: Progress
) -> tuple[GroupErrors, ...]:
    found = []
    precisions = [FLOAT32, INT8] if options.int8 else [FLOAT32]
    localizers = {p: Localizer(folder, int8=p == INT8) for p in precisions}
    for group in judged_groups(data):
        rows = spread_rows(len(group), options.loss_images)
        for precision, localizer in localizers.items():
            poses = Poses.unknown(len(rows))
            for k, row in enumerate(rows):
                progress(f"{group.name} {precision}", k, len(rows))
                image = group.image(int(row))
                matrix = _scaled(group.intrinsics[row], deployed, image)
                located = localizer.decode(localizer.run(deployed.sized(image)), matrix)
                poses.centers[k] = located.poses.centers[0]
                poses.quats_wxyz[k] = located.poses.quats_wxyz[0]
            error, error_deg = pose_errors(poses, group.poses[rows])
            progress(f"{group.name} {precision}", len(rows), len(rows))
            found.append(
                GroupErrors(
                    group=group.name,
                    precision=precision,
                    images=len(rows),
                    located=int(np.isfinite(error).sum()),
                    position=float(np.median(np.nan_to_num(error, nan=np.inf))),
                    rotation_deg=float(np.median(np.nan_to_num(error_deg, nan=np.inf))),
                )
            )
    return tuple(found)
