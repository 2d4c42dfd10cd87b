"""Trained networks on the groups of a data set, beside what needs no network. Nothing is ever aligned."""

from __future__ import annotations

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
from spn_model.evaluation.baselines import GEM, VLAD, better, guess_mean, oracle, posed
from spn_model.evaluation.dropout import dropout_estimates, has_dropout
from spn_model.evaluation.metrics import (
    Estimates,
    Evaluation,
    EvaluationFrames,
    axes_of,
    evaluate,
    evaluation_frames,
)
from spn_model.evaluation.retrieval import most_alike
from spn_model.evaluation.validation import spread_rows
from spn_model.models.checkpoint import Checkpoint
from spn_model.models.pose_model import PoseEstimates, PoseModel
from spn_model.onboard.view import View

_SAME_DEG, _SAME_M, _SAME_PX = 1e-9, 1e-3, 1e-3


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is judged, and beside what."""

    # Of the training images, spread evenly: errors there tell what the network has learnt by heart.
    training_images: int = 200
    batch: int = 8  # images given to a network at once
    baselines: bool = True
    dropout_samples: int = 0  # Monte-Carlo dropout beside each network that has dropout; 0: none
    seed: int = 0  # of dropout


@dataclass(frozen=True)
class NetworkCost:
    """Of one network, after a first image that does not count: images as they lie in the data set to poses.

    seconds : wall clock; cpu_seconds : of this process, all its threads; batch : images given at once.
    """

    images: int
    seconds: float
    cpu_seconds: float
    batch: int
    threads: int
    device: str


@dataclass(frozen=True, eq=False)
class EvaluatedGroup:
    """One group. estimates, evaluations : of the same methods, networks first. retrieval : the better one
    of the two, None without baselines and for training images, each of which would find itself."""

    role: Role
    frames: EvaluationFrames
    estimates: tuple[Estimates, ...]
    evaluations: tuple[Evaluation, ...]
    retrieval: str | None


@dataclass(frozen=True, eq=False)
class NetworkComparison:
    """Networks and baselines on all groups: test, validation, training.

    networks : names of networks, of Monte-Carlo dropout too; costs : by network; notes : one sentence each.
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
    """Judge networks, by name, on all test groups, validation frames and a sample of the training frames.

    world_names : fingerprints of a data set that decide its world; kept : see `most_alike`.
    Raises InputError where the data set is of another world than a network's, or has no frames to judge by;
    FormatError where it is no data set, or of another version.
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
            learnt = [g.name for g in groups if g.name in network.facts.get("trained_on", ())]
            if learnt:
                notes.append(
                    f"{name} was trained on {', '.join(learnt)} too: there its errors are those of training "
                    "images, and baselines knew less."
                )
            parts, costs[name] = _estimated(network.model, chosen, progress, name, options)
            for estimates, part in zip(found, parts, strict=True):
                estimates.append(Estimates(name, part.poses, part.covariance))
            if options.dropout_samples:
                if not has_dropout(network.model):
                    notes.append(f"{name} has no dropout: there is nothing to sample.")
                    continue
                told = f"{name}, {options.dropout_samples} dropout samples"
                parts, costs[told] = _estimated(
                    network.model, chosen, progress, told, options, options.dropout_samples
                )
                for estimates, part in zip(found, parts, strict=True):
                    estimates.append(Estimates(told, part.poses, part.covariance))
        alike = most_alike(data, training, groups, progress, kept) if options.baselines else None
        judged = []
        for k, (group, of) in enumerate(chosen):
            if options.baselines:
                found[k].append(guess_mean(training.poses, len(of)))
            if alike is not None and group is not training:
                looked_up = [posed(m, training.poses, alike[m][k]) for m in (VLAD, GEM)]
                found[k] += [*looked_up, oracle(training.poses, group.poses)]
            evaluations = tuple(evaluate(one, frames[k]) for one in found[k])
            retrieval = [e for e in evaluations if e.method in (VLAD, GEM)]
            best = better(retrieval).method if retrieval else None
            judged.append(EvaluatedGroup(group.role, frames[k], tuple(found[k]), evaluations, best))
        if len(rows) < len(training):
            notes.append(f"Of {len(training)} training images, {len(rows)} are judged.")
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
    """Raises InputError where poses of a network and labels of a data set cannot be compared.

    The data set that it was trained on can. Another one is of the same world where unit, origin and what
    decides the world are the same, and a network that knows one camera needs images of that one.
    """
    view = network.view
    if fingerprint == view.dataset:
        return
    why = _other_world(view, data, world_names)
    if why:
        raise InputError(
            f"is of another world than the one that {name} was trained in: {why}; errors would mean "
            "nothing. Train anew on this data set, or name the one that it was trained on",
            path=data.path,
        )
    if not network.model.any_camera and not _same_camera(view, data):
        raise InputError(
            f"its images are of another camera than the one that {name} was trained for, and its kind of "
            "network knows no other; make the data set with the same rendering",
            path=data.path,
        )


def _other_world(view: View, data: Dataset, names: Sequence[str]) -> str | None:
    info = data.info
    if info.units != view.units:
        return f"lengths are in units {info.units!r}, the network's in {view.units!r}"
    if info.up_is_known != view.up_is_known:
        return "only one of the two knows where up is"
    here, there = info.origin, view.origin
    if (here is None) != (there is None):
        return "only one of the two has a known place"
    if here is not None and there is not None:
        apart = max(abs(here.lat_deg - there.lat_deg), abs(here.lon_deg - there.lon_deg))
        heights_differ = abs(here.alt_m - there.alt_m) > _SAME_M
        if apart > _SAME_DEG or heights_differ or here.height_reference != there.height_reference:
            return "its origin is another"
    decided = [name for name in names if name in info.fingerprints or name in view.made_from]
    if not decided:
        return "nothing tells that both are of the same map"
    for name in decided:
        if info.fingerprints.get(name) != view.made_from.get(name):
            return f"{name} is another"
    return None


def _same_camera(view: View, data: Dataset) -> bool:
    here, there = data.info.camera, view.camera
    if here is None or there is None:
        return here is there
    return (here.width, here.height) == (there.width, there.height) and bool(
        np.allclose(here.matrix, there.matrix, rtol=0, atol=_SAME_PX)
    )


def _groups(data: Dataset) -> tuple[DatasetGroup, list[DatasetGroup], list[str]]:
    """The training group; those to judge by, test before validation; what was left out."""
    of_training = [group for group in data.of_role(Role.TRAIN) if len(group)]
    if len(of_training) != 1:
        raise InputError(
            f"has {len(of_training)} groups with training frames, where one is needed to compare with",
            path=data.path,
        )
    found = [*data.of_role(Role.TEST), *data.of_role(Role.VALIDATION)]
    groups = [group for group in found if len(group)]
    if not groups:
        raise InputError(
            "holds no frames to judge a network by: every test and validation group is empty",
            path=data.path,
        )
    notes = [f"Group {group.name} is empty: left out." for group in found if not len(group)]
    return of_training[0], groups, notes


def _estimated(
    model: PoseModel,
    chosen: Sequence[tuple[DatasetGroup, np.ndarray]],
    progress: Progress,
    name: str,
    options: EvaluateOptions,
    samples: int = 0,
) -> tuple[list[PoseEstimates], NetworkCost]:
    """What a network says of each part's rows, and what it cost without reading the images."""
    total, done, seconds, cpu = sum(len(rows) for _, rows in chosen), 0, 0.0, 0.0
    group, rows = chosen[0]
    # Caches, threads and kernels are set up by a first image, which would otherwise be counted.
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
        parts.append(PoseEstimates.concatenate(batches))
    device = next(model.network.parameters()).device.type
    return parts, NetworkCost(total, seconds, cpu, options.batch, torch.get_num_threads(), device)
