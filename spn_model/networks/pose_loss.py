"""Losses of pose regressors. Positions x are in the world's unit, whatever a network has inside.

Quaternions are (w, x, y, z); the true one is of unit length, the estimated one as the network gives it.
As q and -q are one rotation, the nearer of the two true ones counts. Losses are of each image, (B,).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_NEAREST = 0.1  # share of the true depth: an estimated camera sees no point nearer than that


def beta_weighted(x: Tensor, q: Tensor, true_x: Tensor, true_q: Tensor, beta: float) -> Tensor:
    """|x - x*| + beta |q - q*|, Euclidean lengths; beta is world units per unit of the quaternion.

    Müller, Urban, Jutzi 2017; Kendall, Grimes, Cipolla 2015, equation 2. (B,) from (B, 3) and (B, 4).
    """
    off = torch.linalg.vector_norm(q - nearer_sign(q, true_q), dim=1)
    return torch.linalg.vector_norm(x - true_x, dim=1) + beta * off


class LearnedWeighting(nn.Module):
    """L_x exp(-s_x) + s_x + L_q exp(-s_q) + s_q with learned s, and sums of absolute differences L.

    Kendall and Cipolla 2017, "Geometric loss functions for camera pose regression with deep learning",
    equation 7, with their norm and starting values.
    """

    def __init__(self) -> None:
        super().__init__()
        self.s_x = nn.Parameter(torch.tensor(0.0))
        self.s_q = nn.Parameter(torch.tensor(-3.0))

    def forward(self, x: Tensor, q: Tensor, true_x: Tensor, true_q: Tensor) -> Tensor:
        """(B,) from x (B, 3) and q (B, 4)."""
        position = (x - true_x).abs().sum(dim=1)
        rotation = (q - nearer_sign(q, true_q)).abs().sum(dim=1)
        return position * (-self.s_x).exp() + self.s_x + rotation * (-self.s_q).exp() + self.s_q


def reprojection(
    x: Tensor,
    q: Tensor,
    true_x: Tensor,
    true_q: Tensor,
    points: Tensor,
    seen: Tensor,
    matrices: Tensor,
) -> Tensor:
    """Mean distance, |dx| + |dy| in pixels, between where an image's points appear from either pose.

    Kendall and Cipolla 2017, equation 10. points : (B, P, 3) in the frame of x, in front of the true camera
    where seen (B, P); matrices : (B, 3, 3), K. An image without points has 0. A point that an estimated pose
    puts behind the camera, or nearer than a tenth of its true depth, counts with that tenth: one pixel
    would else be worth any number of others.
    """
    true_in_camera = _in_camera(true_x, true_q, points)
    # A point that is not seen may lie anywhere: it must give no NaN to the gradient.
    depth = torch.where(seen, true_in_camera[..., 2], 1.0)
    ahead = torch.tensor([0.0, 0.0, 1.0]).to(points)
    true_in_camera = torch.where(seen[..., None], true_in_camera, ahead)
    in_camera = torch.where(seen[..., None], _in_camera(x, q, points), ahead)
    nearest = torch.maximum(in_camera[..., 2], _NEAREST * depth)
    there = in_camera[..., :2] / nearest[..., None]
    away = (there - true_in_camera[..., :2] / depth[..., None]) @ matrices[:, :2, :2].transpose(
        1, 2
    )
    distance = (away.abs().sum(dim=2) * seen).sum(dim=1)
    return distance / seen.sum(dim=1).clamp(min=1)


def nearer_sign(q: Tensor, true_q: Tensor) -> Tensor:
    """true_q or -true_q (B, 4), whichever lies nearer to q."""
    return torch.where((q * true_q).sum(dim=1, keepdim=True) < 0, -true_q, true_q)


def residuals(x: Tensor, q: Tensor, true_x: Tensor, true_q: Tensor) -> Tensor:
    """(B, 6): true minus estimated position; rotation vector v in the camera frame, R_true = exp(v) R."""
    w, i, j, k = nn.functional.normalize(q, dim=1).unbind(1)
    # Columns: what right multiplication by the conjugate of q makes of each unit of the true one.
    product = torch.stack(
        [
            torch.stack([w, i, j, k], 1),
            torch.stack([-i, w, -k, j], 1),
            torch.stack([-j, k, w, -i], 1),
            torch.stack([-k, -j, i, w], 1),
        ],
        1,
    )  # (B, 4, 4)
    turn = (product @ true_q[..., None])[..., 0]
    turn = torch.where(turn[:, :1] < 0, -turn, turn)
    sine = torch.linalg.vector_norm(turn[:, 1:], dim=1, keepdim=True)
    angle = 2 * torch.atan2(sine, turn[:, :1])
    vector = turn[:, 1:] * torch.where(sine > 1e-6, angle / sine.clamp(min=1e-6), 2.0)
    return torch.cat([true_x - x, vector], 1)


def laplace(errors: Tensor, log_std: Tensor) -> Tensor:
    """Negative log likelihood (B,), without its constant, of errors (B, 6) of stated standard deviations.

    Each component has a Laplace distribution: its standard deviation is sqrt(2) times its scale.
    """
    return (2**0.5 * errors.abs() * (-log_std).exp() + log_std).sum(dim=1)


def _in_camera(x: Tensor, q: Tensor, points: Tensor) -> Tensor:
    """(B, P, 3) in the cameras' frames."""
    away = points - x[:, None]
    q = nn.functional.normalize(q, dim=1)
    w, v = q[:, None, :1], q[:, None, 1:].expand_as(away)
    cross = torch.linalg.cross(v, away)
    return away + 2 * (w * cross + torch.linalg.cross(v, cross))
