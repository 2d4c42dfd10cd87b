"""Losses of pose regressors.

Positions x are in the world's unit, whatever unit a network uses internally. Quaternions are (w, x, y, z);
the true one has unit length, the estimated one is used as the network outputs it. Since q and -q are the
same rotation, the loss uses the sign of the true quaternion that is nearer to the estimate. Losses have one
value for each image, shape (B,).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_NEAREST = 0.1  # fraction of the true depth, to which depths in an estimated camera are clamped


def beta_weighted_loss(x: Tensor, q: Tensor, true_x: Tensor, true_q: Tensor, beta: float) -> Tensor:
    """Return the beta-weighted pose loss ``|x - x*| + beta |q - q*|`` with Euclidean lengths.

    Parameters
    ----------
    x, true_x : Tensor, shape (B, 3)
        Estimated and true positions.
    q, true_q : Tensor, shape (B, 4)
        Estimated and true quaternions.
    beta : float
        Weight of the rotation, in world units per unit of the quaternion's length.

    Returns
    -------
    Tensor, shape (B,)

    References
    ----------
    Müller, Urban, Jutzi 2017; Kendall, Grimes, Cipolla 2015, equation 2.
    """
    rotation = torch.linalg.vector_norm(q - nearest_sign(q, true_q), dim=1)
    return torch.linalg.vector_norm(x - true_x, dim=1) + beta * rotation


class LearnedWeighting(nn.Module):
    """Pose loss ``L_x exp(-s_x) + s_x + L_q exp(-s_q) + s_q`` with learned s and L1 distances L.

    Kendall and Cipolla 2017, "Geometric loss functions for camera pose regression with deep learning",
    equation 7, with their norm and initial values.
    """

    def __init__(self) -> None:
        super().__init__()
        self.s_x = nn.Parameter(torch.tensor(0.0))
        self.s_q = nn.Parameter(torch.tensor(-3.0))

    def forward(self, x: Tensor, q: Tensor, true_x: Tensor, true_q: Tensor) -> Tensor:
        """Return the loss (B,) of positions x (B, 3) and quaternions q (B, 4)."""
        position = (x - true_x).abs().sum(dim=1)
        rotation = (q - nearest_sign(q, true_q)).abs().sum(dim=1)
        return position * (-self.s_x).exp() + self.s_x + rotation * (-self.s_q).exp() + self.s_q


def reprojection_loss(
    x: Tensor,
    q: Tensor,
    true_x: Tensor,
    true_q: Tensor,
    points: Tensor,
    seen: Tensor,
    matrices: Tensor,
) -> Tensor:
    """Return the mean L1 reprojection error, |dx| + |dy| in pixels, between the true and the estimated pose.

    Parameters
    ----------
    x, true_x : Tensor, shape (B, 3)
        Estimated and true positions.
    q, true_q : Tensor, shape (B, 4)
        Estimated and true quaternions.
    points : Tensor, shape (B, P, 3)
        Points in the frame of x, in front of the true camera where `seen`.
    seen : Tensor of bool, shape (B, P)
        Which points the image shows.
    matrices : Tensor, shape (B, 3, 3)
        Intrinsic matrices K.

    Returns
    -------
    Tensor, shape (B,)
        0 for an image without points.

    Notes
    -----
    A point that the estimated pose puts behind the camera, or nearer than a tenth of its true depth, is
    clamped to that tenth; otherwise a single point could outweigh any number of others.

    References
    ----------
    Kendall and Cipolla 2017, equation 10.
    """
    true_in_camera = _in_camera(true_x, true_q, points)
    # Points that are not seen may be anywhere; replace them so that they put no NaN into the gradient.
    depth = torch.where(seen, true_in_camera[..., 2], 1.0)
    ahead = torch.tensor([0.0, 0.0, 1.0]).to(points)
    true_in_camera = torch.where(seen[..., None], true_in_camera, ahead)
    in_camera = torch.where(seen[..., None], _in_camera(x, q, points), ahead)
    nearest = torch.maximum(in_camera[..., 2], _NEAREST * depth)
    estimated = in_camera[..., :2] / nearest[..., None]
    error_px = (estimated - true_in_camera[..., :2] / depth[..., None]) @ matrices[
        :, :2, :2
    ].transpose(1, 2)
    distance = (error_px.abs().sum(dim=2) * seen).sum(dim=1)
    return distance / seen.sum(dim=1).clamp(min=1)


def nearest_sign(q: Tensor, true_q: Tensor) -> Tensor:
    """Return true_q or -true_q (B, 4), whichever is nearer to q."""
    return torch.where((q * true_q).sum(dim=1, keepdim=True) < 0, -true_q, true_q)


def pose_residuals(x: Tensor, q: Tensor, true_x: Tensor, true_q: Tensor) -> Tensor:
    """Return the pose residuals of estimates as 6-vectors.

    Parameters
    ----------
    x, true_x : Tensor, shape (B, 3)
        Estimated and true positions.
    q, true_q : Tensor, shape (B, 4)
        Estimated and true quaternions; q need not be normalised.

    Returns
    -------
    Tensor, shape (B, 6)
        True minus estimated position, then the rotation vector v in the camera frame with R_true = exp(v)
        R.
    """
    w, i, j, k = nn.functional.normalize(q, dim=1).unbind(1)
    # Matrix of the right multiplication by the conjugate of q: column k is the image of unit quaternion k.
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


def laplace_nll(errors: Tensor, log_std: Tensor) -> Tensor:
    """Return the negative log-likelihood of pose residuals under a Laplace distribution of each component.

    Parameters
    ----------
    errors : Tensor, shape (B, 6)
        Residuals as from `pose_residuals`.
    log_std : Tensor, shape (B, 6)
        Log standard deviations; the standard deviation is sqrt(2) times the Laplace scale.

    Returns
    -------
    Tensor, shape (B,)
        Without the constant term.
    """
    return (2**0.5 * errors.abs() * (-log_std).exp() + log_std).sum(dim=1)


def _in_camera(x: Tensor, q: Tensor, points: Tensor) -> Tensor:
    """Transform points into the cameras' frames, (B, P, 3)."""
    away = points - x[:, None]
    q = nn.functional.normalize(q, dim=1)
    w, v = q[:, None, :1], q[:, None, 1:].expand_as(away)
    cross = torch.linalg.cross(v, away)
    return away + 2 * (w * cross + torch.linalg.cross(v, cross))
