"""Evaluation of trained networks and baselines on the groups of a data set, without any alignment."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.work.timing import Progress
from spn_model.evaluation.baselines import (
    GEM,
    VLAD,
    better_retrieval,
    estimates_at,
    mean_pose_estimates,
    nearest_pose_estimates,
)
from spn_model.evaluation.dropout import dropout_estimates, has_dropout
from spn_model.evaluation.metrics import (
    Estimates,
    Evaluation,
    EvaluationFrames,
    axes_of,
    evaluate,
    evaluation_frames,
)
from spn_model.evaluation.retrieval import most_similar_images
from spn_model.evaluation.validation import spread_rows
from spn_model.models.checkpoint import Checkpoint
from spn_model.models.pose_model import PoseEstimates
from spn_model.onboard.view import View

_logger = logging.getLogger(__name__)

_SAME_DEG, _SAME_M, _SAME_PX = 1e-9, 1e-3, 1e-3


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is evaluated, and which baselines are computed.

    Attributes
    ----------
    training_images : int
        Number of training images to evaluate as well, evenly spread. Their errors show how far the network
        memorises its training set.
    batch : int
        Batch size.
    baselines : bool
        Whether the baselines are computed.
    dropout_samples : int
        Samples of Monte-Carlo dropout, for each network that has dropout; 0 disables it.
    seed : int
        Random seed of dropout.
    """

    training_images: int = 200
    batch: int = 8
    baselines: bool = True
    dropout_samples: int = 0
    seed: int = 0


@dataclass(frozen=True)
class NetworkCost:
    """Cost of estimating poses with one network, from pixels in memory to poses, after one warm-up image.

    seconds : wall clock; cpu_seconds : CPU time of all threads of this process; batch : batch size.
    """

    images: int
    seconds: float
    cpu_seconds: float
    batch: int
    threads: int
    device: str


@dataclass(frozen=True, eq=False)
class EvaluatedGroup:
    """Estimates and evaluations of all methods on one group.

    Attributes
    ----------
    role : Role
        Role of the group in the data set.
    frames : EvaluationFrames
        The evaluated frames.
    estimates : tuple of Estimates
        By method, networks first.
    evaluations : tuple of Evaluation
        Of the same methods in the same order.
    retrieval : str or None
        Name of the better retrieval method; None without baselines, and for training images, each of which
        would retrieve itself.
    """

    role: Role
    frames: EvaluationFrames
    estimates: tuple[Estimates, ...]
    evaluations: tuple[Evaluation, ...]
    retrieval: str | None


@dataclass(frozen=True, eq=False)
class NetworkComparison:
    """Networks and baselines on all groups: test, validation, training.

    Attributes
    ----------
    training : Poses
        All training poses.
    units : str
        "m" or "model".
    dataset : Path
        The evaluated data set.
    fingerprint : str
        Its fingerprint.
    groups : tuple of EvaluatedGroup
        In the order test, validation, training.
    networks : tuple of str
        Names of the networks, and of their Monte-Carlo dropout estimates.
    costs : mapping of str to NetworkCost
        By name in `networks`.
    notes : tuple of str
        One sentence each.
    """

    training: Poses
    units: str
    dataset: Path
    fingerprint: str
    groups: tuple[EvaluatedGroup, ...]
    networks: tuple[str, ...]
    costs: Mapping[str, NetworkCost]
    notes: tuple[str, ...] = field(default=())


def compare(
    path: Path,
    networks: Mapping[str, Checkpoint],
    world_names: Sequence[str],
    progress: Progress,
    options: EvaluateOptions | None = None,
    *,
    kept: Path | None = None,
) -> NetworkComparison:
    """Evaluate networks on all test groups, the validation frames and a sample of the training frames.

    Parameters
    ----------
    path : Path
        Data set.
    networks : mapping of str to Checkpoint
        Networks by name.
    world_names : sequence of str
        Names of the fingerprints that identify the world of a data set.
    progress : Progress
        Receives the network's name, frames done, and frames in total.
    options : EvaluateOptions, optional
        What is evaluated.
    kept : Path, optional
        Cache of the retrieval baselines, see `most_similar_images`.

    Returns
    -------
    NetworkComparison

    Raises
    ------
    InputError
        If the data set belongs to another world than a network, or has no frames to evaluate on.
    FormatError
        If the file is not a data set, or has another version.
    """
    options = options or EvaluateOptions()
    with Dataset(path) as data:
        fingerprint = content_fingerprint(path)
        for name, network in networks.items():
            check_world(network, data, name, world_names, fingerprint)
        training, groups, notes = _groups(data)
        rows = spread_rows(len(training), options.training_images)
        chosen = [(group, np.arange(len(group))) for group in groups] + [(training, rows)]
        frames = [
            evaluation_frames(
                group.name,
                group.names[of],
                group.strata[of],
                group.poses[of],
                training.poses,
                axes=axes_of(data.info),
            )
            for group, of in chosen
        ]
        found: list[list[Estimates]] = [[] for _ in chosen]
        costs = {}
        for name, network in networks.items():
            learned = [g.name for g in groups if g.name in network.facts.get("trained_on", ())]
            if learned:
                notes.append(
                    f"{name} was also trained on {', '.join(learned)}: its errors there are training errors, "
                    "and the baselines did not use those images."
                )
            _logger.debug("%s: poses of %d groups", name, len(chosen))
            parts, costs[name] = _estimate_poses(network, chosen, progress, name, options)
            for estimates, part in zip(found, parts, strict=True):
                estimates.append(Estimates(name, part.poses, part.covariance))
            if options.dropout_samples:
                if not has_dropout(network.model):
                    notes.append(f"{name} has no dropout layers: Monte-Carlo dropout was skipped.")
                    continue
                method = f"{name}, {options.dropout_samples} dropout samples"
                parts, costs[method] = _estimate_poses(
                    network, chosen, progress, method, options, options.dropout_samples
                )
                for estimates, part in zip(found, parts, strict=True):
                    estimates.append(Estimates(method, part.poses, part.covariance))
        most_similar = (
            most_similar_images(data, training, groups, progress, kept)
            if options.baselines
            else None
        )
        judged = []
        for k, (group, of) in enumerate(chosen):
            if options.baselines:
                found[k].append(mean_pose_estimates(training.poses, len(of)))
            if most_similar is not None and group is not training:
                looked_up = [
                    estimates_at(m, training.poses, most_similar[m][k]) for m in (VLAD, GEM)
                ]
                found[k] += [*looked_up, nearest_pose_estimates(training.poses, group.poses)]
            evaluations = tuple(evaluate(one, frames[k]) for one in found[k])
            retrieval = [e for e in evaluations if e.method in (VLAD, GEM)]
            best = better_retrieval(retrieval).method if retrieval else None
            judged.append(EvaluatedGroup(group.role, frames[k], tuple(found[k]), evaluations, best))
        if len(rows) < len(training):
            notes.append(f"{len(rows)} of {len(training)} training images were evaluated.")
        return NetworkComparison(
            training.poses,
            data.info.units,
            path,
            fingerprint,
            tuple(judged),
            tuple(costs),
            costs,
            (*notes, *data.info.notes),
        )


def check_world(
    network: Checkpoint, data: Dataset, name: str, world_names: Sequence[str], fingerprint: str
) -> None:
    """Check that poses of a network can be compared with the labels of a data set.

    The data set that the network was trained on always passes. Another one has to have the same unit, origin
    and world fingerprints; if the network supports only one camera, it also has to have images of that
    camera.

    Parameters
    ----------
    network : Checkpoint
        Trained network.
    data : Dataset
        Data set to compare with.
    name : str
        The network's name, for the message.
    world_names : sequence of str
        Names of the fingerprints that identify the world of a data set.
    fingerprint : str
        Fingerprint of `data`.

    Raises
    ------
    InputError
        If worlds or cameras differ.
    """
    view = network.view
    if fingerprint == view.dataset:
        return
    difference = _world_difference(view, data, world_names)
    if difference:
        raise InputError(
            f"belongs to another world than {name} was trained in ({difference}), so errors would be "
            "meaningless; train on this data set, or use one of the world of the training",
            path=data.path,
        )
    if not network.model.any_camera and not _same_camera(view, data):
        raise InputError(
            f"has images of another camera than {name} was trained for, and this kind of network supports "
            "only one; create the data set with the same rendering",
            path=data.path,
        )


def _world_difference(view: View, data: Dataset, names: Sequence[str]) -> str | None:
    """Return how the worlds of network and data set differ, or None if they are the same."""
    info = data.info
    if info.units != view.units:
        return f"its unit is {info.units!r}, the network's is {view.units!r}"
    if info.up_is_known != view.up_is_known:
        return "the vertical is known in only one of the two"
    here, there = info.origin, view.origin
    if (here is None) != (there is None):
        return "only one of the two is georeferenced"
    if here is not None and there is not None:
        apart = max(abs(here.lat_deg - there.lat_deg), abs(here.lon_deg - there.lon_deg))
        heights_differ = abs(here.alt_m - there.alt_m) > _SAME_M
        if apart > _SAME_DEG or heights_differ or here.height_reference != there.height_reference:
            return "its origin differs"
    decided = [name for name in names if name in info.fingerprints or name in view.made_from]
    if not decided:
        return "no fingerprint shows that both belong to the same map"
    for name in decided:
        if info.fingerprints.get(name) != view.made_from.get(name):
            return f"{name} differs"
    return None


def _same_camera(view: View, data: Dataset) -> bool:
    here, there = data.info.camera, view.camera
    if here is None or there is None:
        return here is there
    return (here.width, here.height) == (there.width, there.height) and bool(
        np.allclose(here.matrix, there.matrix, rtol=0, atol=_SAME_PX)
    )


def _groups(data: Dataset) -> tuple[DatasetGroup, list[DatasetGroup], list[str]]:
    """Return the training group, the groups to evaluate (test first), and notes on skipped groups."""
    of_training = [group for group in data.of_role(Role.TRAIN) if len(group)]
    if len(of_training) != 1:
        raise InputError(
            f"has {len(of_training)} groups with training frames; exactly one is needed",
            path=data.path,
        )
    found = [*data.of_role(Role.TEST), *data.of_role(Role.VALIDATION)]
    groups = [group for group in found if len(group)]
    if not groups:
        raise InputError(
            "has no frames to evaluate on: every test and validation group is empty",
            path=data.path,
        )
    notes = [f"Group {group.name} is empty and was skipped." for group in found if not len(group)]
    return of_training[0], groups, notes


def _estimate_poses(
    network: Checkpoint,
    chosen: Sequence[tuple[DatasetGroup, np.ndarray]],
    progress: Progress,
    name: str,
    options: EvaluateOptions,
    samples: int = 0,
) -> tuple[list[PoseEstimates], NetworkCost]:
    """Return a network's estimates of the chosen rows of each group, and its cost without image reading."""
    model = network.model
    total, done, seconds, cpu = sum(len(rows) for _, rows in chosen), 0, 0.0, 0.0
    group, rows = chosen[0]
    # Warm-up: the first image sets up caches, threads and kernels, which must not be timed.
    model.estimate(group.image(int(rows[0]))[None], group.intrinsics[rows[:1]])
    parts = []
    for group, rows in chosen:
        batches = []
        for first in range(0, len(rows), options.batch):
            of = rows[first : first + options.batch]
            images = np.stack([group.image(int(row)) for row in of])
            started, started_cpu = time.perf_counter(), time.process_time()
            if samples:
                batch = dropout_estimates(
                    model, images, group.intrinsics[of], samples, seed=options.seed
                )
            else:
                batch = model.estimate(images, group.intrinsics[of])
            seconds += time.perf_counter() - started
            cpu += time.process_time() - started_cpu
            batches.append(batch)
            done += len(of)
            progress(name, done, total)
        parts.append(PoseEstimates.concatenate(batches).moved_by(network.view.offset))
    device = next(model.network.parameters()).device.type
    return parts, NetworkCost(total, seconds, cpu, options.batch, torch.get_num_threads(), device)
