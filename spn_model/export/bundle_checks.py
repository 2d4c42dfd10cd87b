"""Checks of a bundle against its network: parity with PyTorch, and errors after quantization."""

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

_MIN_POSES = 8  # with fewer poses only the outputs are compared


@dataclass(frozen=True, kw_only=True)
class BundleOptions:
    """What goes into a bundle, and how it is checked.

    Attributes
    ----------
    int8 : bool
        Whether the bundle also holds an 8-bit graph.
    calibration_images : int
        Training images that determine the ranges of 8-bit activations.
    parity_images : int
        Images on which onnxruntime is compared with PyTorch.
    loss_images : int
        Maximum number of images per evaluation sequence on which the errors of both graphs are measured.
    map_mb : float
        Largest size of the landmark map in megabytes; 0 for a bundle without one.
    output_tolerance : float
        Largest allowed difference of an output, as a share of its largest value.
    pose_tolerance : float
        Difference that at least a quarter of the poses stay below, in their own standard deviations.
    """

    int8: bool = True
    calibration_images: int = 64
    parity_images: int = 16
    loss_images: int = 500
    map_mb: float = 0.0
    output_tolerance: float = 1e-4
    pose_tolerance: float = 0.01


@dataclass(frozen=True, kw_only=True)
class Parity:
    """Differences between PyTorch and onnxruntime on real images.

    output : largest difference, as a share of an output's largest value. Medians over the images for which
    both have a pose: position in the world's unit, rotation_deg, and sigmas (the larger of both, in the
    pose's own standard deviations). largest_sigmas : maximum of the latter. disagree : number of images for
    which only one of the two has a pose. If a network is unsure, rounding may make RANSAC choose another
    pose.
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
    """Median errors of one graph on a group; an image without a pose counts as an infinite error."""

    group: str
    precision: str
    images: int
    located: int
    position: float
    rotation_deg: float


def evaluation_groups(data: Dataset) -> list[DatasetGroup]:
    """Return the non-empty groups to evaluate on: test groups, otherwise validation groups.

    A data set with neither is evaluated on its training groups.
    """
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
    """Measure the parity of the float32 graph with PyTorch.

    Raises GeometryError if outputs or poses differ by more than the tolerances.
    """
    localizer = Localizer(folder)
    groups = evaluation_groups(data)
    each = max(1, options.parity_images // len(groups))
    chosen = [(group, int(row)) for group in groups for row in spread_rows(len(group), each)]
    output, disagree, pose_differences = 0.0, 0, []
    for done, (group, row) in enumerate(chosen):
        progress("parity", done, len(chosen))
        image, matrix = group.image(row), group.intrinsics[row]
        sized = deployed.graph_input(image)
        outputs = localizer.run(sized)
        for found, wanted in zip(outputs, reference(deployed, sized), strict=True):
            size = max(float(np.abs(wanted).max()), 1e-6)
            output = max(output, float(np.abs(found - wanted).max()) / size)
        # The network decodes its own outputs, independently of the bundle's decoder.
        torch_pose = checkpoint.model.estimate(image[None], matrix[None])
        torch_pose = torch_pose.moved_by(checkpoint.view.offset)
        located = localizer.decode(outputs, _scaled(matrix, deployed, image))
        disagree += bool(located.reason) != bool(torch_pose.reasons[0])
        if not located.reason and not torch_pose.reasons[0]:
            position, rotation_deg = (
                float(v[0]) for v in pose_errors(located.poses, torch_pose.poses)
            )
            variance = np.diag(torch_pose.covariance[0])
            stated_m, stated = np.sqrt([variance[:3].sum(), variance[3:].sum()])
            sigmas = max(position / stated_m, math.radians(rotation_deg) / stated)
            pose_differences.append((position, rotation_deg, sigmas))
    progress("parity", len(chosen), len(chosen))
    # A network without any pose has no differences.
    differences = np.array(pose_differences or [(0.0, 0.0, 0.0)])
    position, rotation_deg, sigmas = (float(v) for v in np.median(differences, axis=0))
    if not output <= options.output_tolerance:
        raise GeometryError(
            f"the exported graph does not match the network: an output differs by "
            f"{output:.1e} of its largest value (tolerance {options.output_tolerance:.0e})"
        )
    # A wrong graph or decoder moves every pose. Rounding moves only poses for which RANSAC is unsure; a
    # barely trained network has many of these.
    lower_quartile = float(np.quantile(differences[:, 2], 0.25))
    is_known = len(pose_differences) >= min(_MIN_POSES, len(chosen))
    if (is_known and not lower_quartile <= options.pose_tolerance) or disagree > len(chosen) / 2:
        raise GeometryError(
            f"the bundle's poses differ from the network's: three quarters of them by more than "
            f"{lower_quartile:.1e} standard deviations (tolerance {options.pose_tolerance:g}), and "
            f"{disagree} of {len(chosen)} images have a pose from only one of the two"
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
    """Scale the camera matrix of a data set image to the input size of the graph."""
    shrunk = np.diag([deployed.size[0] / image.shape[1], deployed.size[1] / image.shape[0], 1.0])
    scaled: np.ndarray = shrunk @ matrix
    return scaled


def measure_errors(
    folder: Path, deployed: Deployment, data: Dataset, options: BundleOptions, progress: Progress
) -> tuple[GroupErrors, ...]:
    """Measure the median errors of each graph on each evaluation group."""
    found = []
    precisions = [FLOAT32, INT8] if options.int8 else [FLOAT32]
    localizers = {p: Localizer(folder, int8=p == INT8) for p in precisions}
    for group in evaluation_groups(data):
        rows = spread_rows(len(group), options.loss_images)
        for precision, localizer in localizers.items():
            poses = Poses.unknown(len(rows))
            for k, row in enumerate(rows):
                progress(f"{group.name} {precision}", k, len(rows))
                image = group.image(int(row))
                matrix = _scaled(group.intrinsics[row], deployed, image)
                located = localizer.decode(localizer.run(deployed.graph_input(image)), matrix)
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
