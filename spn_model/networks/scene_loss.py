"""Loss of the scene-coordinate network: likelihood of true points under the mixture of each cell."""

from __future__ import annotations

from torch import Tensor


def mixture_loss(candidates: Tensor, log_scale: Tensor, logits: Tensor, targets: Tensor) -> Tensor:
    """Return the mean negative log-likelihood of target points, without its constant.

    Parameters
    ----------
    candidates : Tensor, shape (N, P, 3)
        Means of the components of each cell.
    log_scale : Tensor, shape (N,)
        Log scale that the components of a cell share.
    logits : Tensor, shape (N, P)
        Weights of the components before the softmax.
    targets : Tensor, shape (N, 3)
        True points.

    Returns
    -------
    Tensor, shape ()

    Notes
    -----
    A component is an isotropic Laplace distribution in three dimensions: its density is proportional to
    exp(-distance / scale) / scale^3.
    """
    distance = (candidates - targets[:, None]).square().sum(2).add(1e-12).sqrt()
    each = logits.log_softmax(1) - distance * (-log_scale).exp()[:, None]
    return (3 * log_scale - each.logsumexp(1)).mean()
