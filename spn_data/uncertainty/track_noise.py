"""Correlated measurement errors along a track: keypoints drift as their view changes.

Model of the n errors of a track, in each of x and y: covariance
s^2 sigma^2 (w + (1 - w) exp(-change / length)) between two of its frames, with w only for a frame with
itself. The change of view combines the change of the direction to the point (radians) and of the logarithm of
its distance. s^2 varies between tracks: inverse gamma with mean near 1, so that errors have the tails of
Student's t. Estimated by restricted maximum likelihood (REML): from residuals after the point is eliminated.

References
----------
Patterson and Thompson 1971 (REML); Lange, Little and Taylor 1989 (Student's t).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import optimize
from scipy.special import gammaln

from spn_data.uncertainty.bundle_jacobians import LinearizedBundle

# Much longer than the views of any track, so that drift grows linearly with the change of view. It is not
# estimated because only its ratio to the variance matters then.
_LENGTH = 3.0
_RIDGE = 1e-9  # for points with parallel rays, whose depth explains no residual
_FITTED_TRACKS = 1000
_TRACK_LENGTHS = (4, 30)  # of the tracks to fit; shorter ones contain no information on drift


@dataclass(frozen=True, eq=False)
class TrackNoise:
    """Parameters of the noise model.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of one component in a typical track.
    apart : float
        w, the uncorrelated share of the variance.
    length : float
        Change of view over which the correlation of the rest decays.
    tails : float
        Degrees of freedom of Student's t.
    """

    sigma_px: float
    apart: float
    length: float
    tails: float

    def correlations(self, views: np.ndarray) -> np.ndarray:
        """Return the correlations (..., n, n) between the errors of a track seen in views (..., n, 4)."""
        shared = (1 - self.apart) * _drift(views, self.length)
        return shared + self.apart * np.eye(views.shape[-2])


@dataclass(frozen=True, eq=False)
class _Tracks:
    """T tracks of n measurements each.

    Attributes
    ----------
    point : ndarray, shape (T,)
        Their points.
    views : ndarray, shape (T, n, 4)
        As in `LinearizedBundle`.
    whitened : ndarray, shape (T, n, 2, 3)
        As in `LinearizedBundle`.
    residuals : ndarray, shape (T, n, 2)
        Residuals in px.
    """

    point: np.ndarray
    views: np.ndarray
    whitened: np.ndarray
    residuals: np.ndarray


@dataclass(frozen=True, eq=False)
class _Spectra:
    """T tracks of n measurements each, in the directions in which their drifts are independent.

    Attributes
    ----------
    drifts : ndarray, shape (T, n)
        Variances of the drifts in these directions.
    values : ndarray, shape (T, n, 2, 4)
        The whitened derivatives and the residuals there.
    """

    drifts: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, tracks: _Tracks) -> _Spectra:
        """Decompose tracks; the directions depend on their views alone."""
        drifts, directions = np.linalg.eigh(_drift(tracks.views, _LENGTH))
        values = np.concatenate([tracks.whitened, tracks.residuals[..., None]], axis=3)
        return cls(drifts, np.einsum("tnm,tnki->tmki", directions, values, optimize=True))


def _drift(views: np.ndarray, length: float) -> np.ndarray:
    """Return the correlations (..., n, n) of what drifts between views (..., n, 4)."""
    squared = np.zeros((*views.shape[:-1], views.shape[-2]))
    for axis in range(views.shape[-1]):
        column = views[..., axis]
        squared += (column[..., :, None] - column[..., None, :]) ** 2
    return np.asarray(np.exp(-np.sqrt(squared) / length))


def fit_track_noise(bundle: LinearizedBundle) -> TrackNoise:
    """Fit the maximum-likelihood noise model to a sample of a bundle's tracks."""
    lengths = np.bincount(bundle.point)
    usable = np.flatnonzero((lengths >= _TRACK_LENGTHS[0]) & (lengths <= _TRACK_LENGTHS[1]))
    if len(usable) == 0:
        usable = np.flatnonzero(lengths > 0)
    chosen = np.random.default_rng(0).permutation(usable)[:_FITTED_TRACKS]
    tracks = list(_tracks(bundle, chosen))
    variance = np.median(np.concatenate([(t.residuals**2).mean(axis=(1, 2)) for t in tracks]))
    spectra = [_Spectra.of(t) for t in tracks]
    start = np.array([np.log(max(2 * float(variance), 1e-12)), -1.0, 1.0])
    found = optimize.minimize(
        lambda x: sum(_minus_log_likelihood(one, _noise(x)) for one in spectra),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([start, start + np.eye(3)]),
            "maxfev": 200,
            "xatol": 0.02,
            "fatol": 0.5,
        },
    )
    return _noise(found.x)


def whitened_point_covariances(bundle: LinearizedBundle, noise: TrackNoise | None) -> np.ndarray:
    """Return the covariances of the points' own errors in whitened coordinates.

    Parameters
    ----------
    bundle : LinearizedBundle
        The measurements.
    noise : TrackNoise or None
        The noise model; None for independent errors of 1 px.

    Returns
    -------
    ndarray, shape (P, 3, 3)
        F, with Q^T F Q the covariance of a point due to its own measurement errors (Q is `bundle.whitening`).
    """
    own = np.zeros_like(bundle.whitening)
    if noise is None:
        return own + np.eye(3)
    for tracks in _tracks(bundle, np.arange(len(bundle.points))):
        correlations = noise.correlations(tracks.views)
        shape = np.einsum(
            "tnki,tnkj->tij",
            tracks.whitened,
            np.einsum("tmn,tnki->tmki", correlations, tracks.whitened, optimize=True),
        )
        # Zero except for points with parallel rays, whose depth remains undetermined.
        undetermined = np.eye(3) - np.einsum("tnki,tnkj->tij", tracks.whitened, tracks.whitened)
        values = np.concatenate([tracks.whitened, tracks.residuals[..., None]], axis=3)
        values = values.reshape(*correlations.shape[:2], 8)
        misfit, _ = _misfit(np.linalg.solve(np.linalg.cholesky(correlations), values))
        redundancy = 2 * tracks.views.shape[1] - 3
        # Posterior mean of this track's variance: its own residuals and the distribution over all tracks.
        variance = (noise.tails * noise.sigma_px**2 + misfit) / max(
            noise.tails + redundancy - 2, noise.tails / 2
        )
        own[tracks.point] = variance[:, None, None] * (shape + undetermined)
    return own


def _noise(x: np.ndarray) -> TrackNoise:
    log_variance, apart, log_tails = np.clip(x, [-60, -7, -5], [60, 7, 5])
    return TrackNoise(
        sigma_px=float(np.exp(0.5 * log_variance)),
        apart=float(1 / (1 + np.exp(-apart))),
        length=_LENGTH,
        tails=float(2 + np.exp(log_tails)),
    )


def _tracks(bundle: LinearizedBundle, points: np.ndarray) -> Iterator[_Tracks]:
    """Yield the tracks of some points, grouped by length."""
    order = np.argsort(bundle.point, kind="stable")
    starts = np.searchsorted(bundle.point[order], points)
    lengths = np.searchsorted(bundle.point[order], points, side="right") - starts
    residuals = bundle.residuals.reshape(-1, 2)
    for length in np.unique(lengths):
        of_length = lengths == length
        rows = order[starts[of_length][:, None] + np.arange(length)]
        yield _Tracks(points[of_length], bundle.views[rows], bundle.whitened[rows], residuals[rows])


def _misfit(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared norm of decorrelated residuals (T,), and log determinants of points (T,).

    Parameters
    ----------
    values : ndarray, shape (T, n, 8)
        Decorrelated derivatives by the whitened point and residuals, in x and in y. Points are eliminated.
    """
    count, n = values.shape[:2]
    scaled = values.reshape(count, 2 * n, 4)
    products = np.swapaxes(scaled, 1, 2) @ scaled
    normal, right_side = products[:, :3, :3], products[:, :3, 3]
    trace = np.trace(normal, axis1=1, axis2=2)
    normal = normal + (_RIDGE * trace)[:, None, None] * np.eye(3)
    misfit = products[:, 3, 3] - np.einsum(
        "ti,ti->t", right_side, np.linalg.solve(normal, right_side[..., None])[..., 0]
    )
    return np.maximum(misfit, 0.0), np.linalg.slogdet(normal)[1]


def _minus_log_likelihood(tracks: _Spectra, noise: TrackNoise) -> float:
    """Return the negative log-likelihood under Student's t, with the constants that depend on its tails."""
    count, n = tracks.drifts.shape
    variances = (1 - noise.apart) * tracks.drifts + noise.apart
    scaled = tracks.values / np.sqrt(variances)[..., None, None]
    misfit, log_det = _misfit(scaled.reshape(count, n, 8))
    log_det = log_det + 2 * np.log(variances).sum(axis=1)
    m, v = 2 * n - 3, noise.tails
    variance = noise.sigma_px**2
    each = (
        0.5 * log_det
        + 0.5 * m * np.log(variance)
        + 0.5 * (v + m) * np.log1p(misfit / (variance * v))
        + 0.5 * m * np.log(v)
        + gammaln(v / 2)
        - gammaln((v + m) / 2)
    )
    return float(each.sum())
