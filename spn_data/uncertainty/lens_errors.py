"""What a camera model does not describe of a real lens: smooth fields of displacements over the image.

A focal length and two radial terms fit a real lens only approximately. What is left is a smooth field over
the image, the same in every frame, and no number of measurements averages it out. The field is expanded in
polynomials; its constant term is an error of the principal point. Bundle adjustment explains a part of the
field by wrong poses, points and intrinsics, and leaves the rest in the residuals. Its coefficients are
estimated in one Gauss-Newton step together with all other unknowns, under a normal prior whose variances are
themselves estimated (empirical Bayes), one for each degree of the polynomials.

References
----------
Ebner 1976, "Self calibrating block adjustment"; Dempster, Laird and Rubin 1977 (EM).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera

PRINCIPAL_POINT_SIGMA = (
    0.01  # of the image width: distance of a principal point from its usual place
)
# Linear terms are a focal length, a rotation of the image, and the shape of the pixels: no errors of a lens.
_DEGREES = (0, 2, 3, 4, 5)  # decentring and thin prisms have degree 2, radial distortion 3 and 5
_USUAL_SIGMA = (
    3e-5  # of the image width: where the measurements do not tell the size of a degree's terms
)
_LARGEST_SIGMA = 2e-4  # of the image width: no usual lens has more beyond its radial distortion
_EM_STEPS = 200
# Share of the usual noise that every pull has: a shift of the principal point together with decentring is
# exactly a rotation of the camera, and what little such terms show is rounding and curvature.
_NOISE_FLOOR = 1e-4
# Largest factor of the variance of pulls that are larger than independent tracks explain: whole images share
# errors too (blur, shutter, haze). Chosen on two crossed flights of one camera, each of which must find the
# lens that both together show.
_MOST_DEPENDENT = 10.0


def _exponents() -> list[tuple[int, int]]:
    return [(i, degree - i) for degree in _DEGREES for i in range(degree + 1)]


TERMS = 2 * len(_exponents())  # x terms, then y terms; the constant ones are first
CONSTANT = (0, len(_exponents()))  # rows of the principal point among them


def _without_radial(camera: Camera) -> np.ndarray:
    """Return the projector (TERMS, TERMS) onto fields that radial distortion does not describe."""
    x, y = np.meshgrid(*[np.polynomial.legendre.leggauss(8)[0]] * 2)
    weights = np.outer(*[np.polynomial.legendre.leggauss(8)[1]] * 2).ravel() / 4
    size = np.array([camera.width, camera.height])
    values = field_values(camera, (np.column_stack([x.ravel(), y.ravel()]) + 1) / 2 * size)
    rays = np.column_stack([x.ravel(), y.ravel()]) * size / camera.width
    squared = (rays**2).sum(axis=1, keepdims=True)
    radial = np.stack(
        [(values.T @ (weights[:, None] * rays * squared**k)).T.ravel() for k in (1, 2)], axis=1
    )
    basis = np.linalg.qr(radial)[0]
    return np.asarray(np.eye(TERMS) - basis @ basis.T)


def field_values(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the basis of the fields at some pixels.

    Parameters
    ----------
    camera : Camera
        Only its image size matters.
    pixels : ndarray, shape (M, 2)

    Returns
    -------
    ndarray, shape (M, TERMS / 2)
        Products of Legendre polynomials in x and y. Their mean square over the image is 1, and each serves
        both components.
    """
    across, down = (
        np.polynomial.legendre.legvander(v, max(_DEGREES))
        * np.sqrt(2 * np.arange(max(_DEGREES) + 1) + 1)
        for v in (2 * pixels / [camera.width, camera.height] - 1).T
    )
    return np.stack([across[:, i] * down[:, j] for i, j in _exponents()], axis=1)


@dataclass(frozen=True)
class FieldEstimate:
    """Coefficients of the fields of a lens, and how wrong it is to take them as zero.

    Attributes
    ----------
    coefficients_px : ndarray, shape (TERMS,)
        Expected values.
    covariance : ndarray, shape (TERMS, TERMS)
        Of their errors.
    """

    coefficients_px: np.ndarray
    covariance: np.ndarray

    @property
    def root(self) -> np.ndarray:
        """Return R (TERMS, TERMS) with R R^T the second moment of the coefficients about zero."""
        moment = self.covariance + np.outer(self.coefficients_px, self.coefficients_px)
        values, vectors = np.linalg.eigh(0.5 * (moment + moment.T))
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def estimate_field(
    camera: Camera,
    information: np.ndarray,
    pull: np.ndarray,
    variance_px2: float,
    *,
    principal_point_is_estimated: bool = False,
) -> FieldEstimate:
    """Estimate the coefficients of a lens's fields from the residuals of an adjustment without them.

    Parameters
    ----------
    camera : Camera
        Only its image size matters.
    information : ndarray, shape (TERMS, TERMS)
        A = F^T F, with all that other unknowns explain of F projected out. F are the derivatives of the
        residuals by the coefficients.
    pull : ndarray, shape (TERMS,)
        -F^T r: where the residuals r pull the coefficients.
    variance_px2 : float
        Covariance of the pull over `information` if tracks are independent.
    principal_point_is_estimated : bool, optional
        Whether the principal point is among the other unknowns.

    Returns
    -------
    FieldEstimate
    """
    degree = np.tile([sum(pair) for pair in _exponents()], 2)
    variance = np.full(TERMS, (_USUAL_SIGMA * camera.width) ** 2)
    held = 0.0 if principal_point_is_estimated else PRINCIPAL_POINT_SIGMA
    variance[degree == 0] = (held * camera.width) ** 2
    noise = variance_px2 * _dependence(information, pull, variance_px2) * information
    noise = noise + _NOISE_FLOOR * np.mean(np.diag(noise)) * np.eye(TERMS)
    largest = (_LARGEST_SIGMA * camera.width) ** 2
    projector = _without_radial(camera)
    for _ in range(_EM_STEPS):
        # pull = A c + n, with c ~ N(0, D) and n ~ N(0, noise)
        prior = projector * variance @ projector
        spread = information @ prior
        gain = np.linalg.solve(spread @ information + noise, spread).T
        mean = gain @ pull
        covariance = prior - gain @ spread
        before = variance.copy()
        for d in _DEGREES[1:]:
            mine = degree == d
            square = np.mean(mean[mine] ** 2 + np.diag(covariance)[mine])
            variance[mine] = min(float(square), largest)
        if np.allclose(variance, before, rtol=1e-3):
            break
    return FieldEstimate(mean, 0.5 * (covariance + covariance.T))


def _dependence(information: np.ndarray, pull: np.ndarray, variance_px2: float) -> float:
    """Return the mean square of the pulls in their best determined directions, in units of their variance."""
    values, vectors = np.linalg.eigh(information)
    best = values >= np.median(values)
    squares = (vectors.T @ pull)[best] ** 2 / (variance_px2 * values[best])
    return float(np.clip(np.mean(squares), 1.0, _MOST_DEPENDENT))
