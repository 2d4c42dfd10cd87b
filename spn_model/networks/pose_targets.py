"""Targets of a pose regressor: positions about the centre of the training poses, and quaternions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats

_ONE_PLACE = 1e-6  # spread, in the world's unit, below which all poses count as one place


class PoseTargets(nn.Module):
    """Centre and spread of the training poses, kept as buffers so that they are part of the network's state.

    The heads regress in units of `scale` about `center`, so that their outputs are near 1 whatever the size
    of the area; losses are in the world's unit.

    Attributes
    ----------
    center : Tensor, float64, shape (3,)
        Mean of the camera centres.
    scale : Tensor, float64, shape ()
        Root mean square distance from `center`; 1 if all poses are at one place.
    hemisphere : Tensor, float64, shape (4,)
        Mean orientation. Since q and -q are the same rotation, the target is the one nearer to it.
    """

    center: Tensor
    scale: Tensor
    hemisphere: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))
        self.register_buffer("hemisphere", torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))

    def fit(self, poses: Poses) -> None:
        """Compute centre, scale and mean orientation from poses (N), N >= 1, all finite.

        The mean orientation is the eigenvector of the largest eigenvalue of the sum of q q^T (Markley et
        al. 2007, "Averaging quaternions", equation 12), which does not depend on the signs of the
        quaternions.
        """
        center = poses.centers.mean(axis=0)
        spread = float(np.sqrt(((poses.centers - center) ** 2).sum(axis=1).mean()))
        mean = np.linalg.eigh(poses.quats_wxyz.T @ poses.quats_wxyz)[1][:, -1]
        self.center.copy_(torch.from_numpy(center))
        self.scale.fill_(spread if spread > _ONE_PLACE else 1.0)
        self.hemisphere.copy_(torch.from_numpy(canonical_quats(mean)))

    def encode(self, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Return offsets (N, 3) from the centre (world's unit) and unit quaternions (N, 4), float32."""
        offsets = poses.centers - self.center.cpu().numpy()
        quats = canonical_quats(poses.quats_wxyz)
        quats *= np.where(quats @ self.hemisphere.cpu().numpy() < 0, -1.0, 1.0)[:, None]
        return offsets.astype(np.float32), quats.astype(np.float32)

    def decode(self, offsets: np.ndarray, quats: np.ndarray) -> Poses:
        """Return the poses of offsets (N, 3) and quaternions (N, 4) of any length and sign.

        A pose is NaN if a value is not finite or its quaternion has no direction.
        """
        offsets, quats = np.asarray(offsets, np.float64), np.asarray(quats, np.float64)
        poses = Poses.unknown(len(offsets))
        length = np.linalg.norm(quats, axis=1)
        good = np.isfinite(offsets).all(axis=1) & np.isfinite(length) & (length > 1e-6)
        poses.centers[good] = offsets[good] + self.center.cpu().numpy()
        poses.quats_wxyz[good] = canonical_quats(quats[good])
        return poses
