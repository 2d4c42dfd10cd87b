"""Pose uncertainty by Monte-Carlo dropout, for comparison with the stated covariances."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotation_vectors
from spn_model.evaluation.baselines import mean_pose
from spn_model.models.pose_model import PoseEstimates, PoseModel

_DROPOUT = (nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.AlphaDropout)
_MIN_SAMPLES = 7  # fewest samples that can give a full-rank 6 x 6 covariance


def has_dropout(model: PoseModel) -> bool:
    """Return whether any dropout layer of the network has a non-zero rate."""
    return any(True for _ in _layers(model))


def dropout_estimates(
    model: PoseModel, images: np.ndarray, intrinsics: np.ndarray, samples: int, *, seed: int = 0
) -> PoseEstimates:
    """Estimate the mean and covariance of poses of images (B, H, W, 3) with dropout kept on.

    Kendall & Cipolla 2016, "Modelling uncertainty in deep learning for camera relocalization", sections 3.2
    and 3.3. The covariance is that of the samples alone, without the covariance that the network itself
    states. An image for which fewer than 7 samples have a pose gets NaN. Raises ValueError for fewer than 7
    samples and for a network without dropout.
    """
    if samples < _MIN_SAMPLES:
        raise ValueError(
            f"{samples} dropout samples cannot give a full-rank covariance; use {_MIN_SAMPLES} or more"
        )
    if not has_dropout(model):
        raise ValueError("the network has no active dropout layer")
    samples_drawn = []
    devices = [next(model.network.parameters()).device]
    with torch.random.fork_rng([d for d in devices if d.type == "cuda"]), _dropping(model):
        torch.manual_seed(seed)
        for _ in range(samples):
            samples_drawn.append(model.estimate(images, intrinsics).poses)
    poses = Poses.unknown(len(images))
    covariance = np.full((len(images), 6, 6), np.nan)
    reasons = np.full(len(images), "", dtype=object)
    for k in range(len(images)):
        of = Poses.concatenate(sample[k : k + 1] for sample in samples_drawn)
        of = of[np.isfinite(of.centers).all(axis=1) & np.isfinite(of.quats_wxyz).all(axis=1)]
        if len(of) < _MIN_SAMPLES:
            reasons[k] = f"only {len(of)} of {samples} dropout samples give a pose"
            continue
        poses.centers[k], poses.quats_wxyz[k] = mean_pose(of)
        turned = of.rotations @ poses.rotations[k].T
        deviations = np.hstack([of.centers - poses.centers[k], rotation_vectors(turned)])
        covariance[k] = np.cov(deviations, rowvar=False)
    return PoseEstimates(poses, covariance, reasons.astype(np.str_))


@contextmanager
def _dropping(model: PoseModel) -> Iterator[None]:
    layers = list(_layers(model))
    for layer in layers:
        layer.train()
    try:
        yield
    finally:
        for layer in layers:
            layer.eval()


def _layers(model: PoseModel) -> Iterator[nn.Module]:
    for layer in model.network.modules():
        if isinstance(layer, _DROPOUT) and layer.p > 0:
            yield layer
