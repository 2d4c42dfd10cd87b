"""What a camera model does not describe of a real lens: smooth fields of displacements over the image.

A focal length and two radial terms fit a real lens only approximately. What is left is a smooth field over
the image, the same in every frame, and no number of measurements averages it out. The field is expanded in
polynomials; its constant term is an error of the principal point. Bundle adjustment explains a part of the
field by wrong poses, points and intrinsics, and leaves the rest in the residuals. Its coefficients are
estimated in one Gauss-Newton step together with all other unknowns, under a normal prior whose variances are
themselves estimated (empirical Bayes): one for decentring, and one for each degree of the polynomials.

A field is the same in all parts of a flight, and errors of measurements are not. The noise of the estimate is
therefore what cross-validation shows: each block of measurements in turn is predicted from the field that the
others show. It does not contain the fields, and it contains errors that whole images share.

References
----------
Ebner 1976, "Self calibrating block adjustment"; Brown 1966, "Decentering distortion of lenses"; Dempster,
Laird and Rubin 1977 (EM).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera

BLOCKS = 16  # of measurements, of which each is predicted from the others
PRINCIPAL_POINT_SIGMA = (
    0.01  # of the image width: distance of a principal point from its usual place
)
# Linear terms are a focal length, a rotation of the image, and the shape of the pixels: no errors of a lens.
_DEGREES = (0, 2, 3, 4, 5)  # decentring and thin prisms have degree 2, radial distortion 3 and 5
_USUAL_DECENTRING, _LARGEST_DECENTRING = 2e-4, 1e-3  # p1 and p2 of calibrated lenses
_USUAL_SIGMA = 3e-6  # of the image width: of other terms
_LARGEST_SIGMA = 2e-4  # of the image width: no usual lens has more beyond its radial distortion
_USUAL_WEIGHT = 0.2  # number of coefficients as large as usual that count beside those of a group
_EM_STEPS = 300
# Share of the usual noise that every pull has: a shift of the principal point together with decentring is
# nearly a rotation of the camera, and what little such terms show is rounding and curvature.
_NOISE_FLOOR = 1e-6
_RIDGE = 1e-9  # of the largest information
_TINY = 1e-12  # keeps matrices regular where measurements tell nothing at all
_FEWEST_BLOCKS = 4  # with fewer, they tell nothing of noise


def _exponents() -> list[tuple[int, int]]:
    return [(i, degree - i) for degree in _DEGREES for i in range(degree + 1)]


TERMS = 2 * len(_exponents())  # x terms, then y terms; the constant ones are first
CONSTANT = (0, len(_exponents()))  # rows of the principal point among them


def _coefficients(camera: Camera, fields: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the coefficients (TERMS, k) of k fields (N, 2, k) of rays (N, 2)."""
    x, y = np.meshgrid(*[np.polynomial.legendre.leggauss(8)[0]] * 2)
    weights = np.outer(*[np.polynomial.legendre.leggauss(8)[1]] * 2).ravel() / 4
    from_center = np.column_stack([x.ravel(), y.ravel()]) / 2 * [camera.width, camera.height]
    values = field_values(camera, from_center + np.array([camera.width, camera.height]) / 2)
    found = np.einsum("nt,n,nck->ctk", values, weights, fields(from_center / camera.focal_px))
    return np.asarray(found.reshape(TERMS, -1))


def _radial(rays: np.ndarray) -> np.ndarray:
    """Return the fields (N, 2, 2) of the radial terms k1 and k2, over the focal length."""
    squared = (rays**2).sum(axis=1)[:, None, None]
    return np.concatenate([rays[..., None] * squared, rays[..., None] * squared**2], axis=2)


def _decentring(rays: np.ndarray) -> np.ndarray:
    """Return the fields (N, 2, 2) of p1 and p2, over the focal length."""
    x, y = rays.T
    both, squared = 2 * x * y, x * x + y * y
    by_p1 = np.column_stack([both, squared + 2 * y * y])
    by_p2 = np.column_stack([squared + 2 * x * x, both])
    return np.stack([by_p1, by_p2], axis=2)


@dataclass(frozen=True, eq=False)
class _Groups:
    """Groups of fields whose sizes have one variance each.

    Attributes
    ----------
    fields : ndarray, shape (TERMS, k)
        Coefficients of the fields.
    group : ndarray, shape (k,), int
        Group of each; those of group 0 have a known variance.
    usual, largest : ndarray, shape (G,)
        Variances of the groups.
    """

    fields: np.ndarray
    group: np.ndarray
    usual: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, camera: Camera, *, principal_point: bool) -> _Groups:
        """Return principal point, decentring, and a group for each degree without radial distortion."""
        degree = np.tile([sum(pair) for pair in _exponents()], 2)
        radial = np.linalg.qr(_coefficients(camera, _radial))[0]
        others = np.eye(TERMS) - radial @ radial.T
        focal_px = float(np.mean(camera.focal_px))
        groups = [
            np.eye(TERMS)[:, degree == 0],
            focal_px * _coefficients(camera, _decentring),
            *[others[:, degree == d] for d in _DEGREES[1:]],
        ]
        held = PRINCIPAL_POINT_SIGMA * camera.width if principal_point else 0.0
        usual = [held, _USUAL_DECENTRING] + [_USUAL_SIGMA * camera.width] * (len(groups) - 2)
        largest = [held, _LARGEST_DECENTRING] + [_LARGEST_SIGMA * camera.width] * (len(groups) - 2)
        index = np.repeat(np.arange(len(groups)), [group.shape[1] for group in groups])
        return cls(np.concatenate(groups, axis=1), index, np.square(usual), np.square(largest))


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
    variance_px2 : float
        Of a residual component, as cross-validation shows it.
    """

    coefficients_px: np.ndarray
    covariance: np.ndarray
    variance_px2: float

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
        Its image size and focal length matter.
    information : ndarray, shape (B, TERMS, TERMS)
        A = F^T F of B blocks of measurements, with all that other unknowns explain of F projected out. F are
        the derivatives of the residuals by the coefficients.
    pull : ndarray, shape (B, TERMS)
        -F^T r: where the residuals r of a block pull the coefficients.
    variance_px2 : float
        Covariance of the pull over `information`, where blocks are too few to tell it.
    principal_point_is_estimated : bool, optional
        Whether the principal point is among the other unknowns.

    Returns
    -------
    FieldEstimate
    """
    groups = _Groups.of(camera, principal_point=not principal_point_is_estimated)
    whole, pulled = information.sum(axis=0), pull.sum(axis=0)
    noise = variance_px2 * whole
    if len(pull) >= _FEWEST_BLOCKS:
        noise, variance_px2 = _held_out_noise(information, pull)
    noise = noise + (_NOISE_FLOOR * np.mean(np.diag(noise)) + _TINY) * np.eye(TERMS)
    through = whole @ groups.fields
    variance = groups.usual.copy()
    for _ in range(_EM_STEPS):
        # pulled = through a + n, with a ~ N(0, D) and n ~ N(0, noise)
        prior = variance[groups.group]
        gain = prior[:, None] * np.linalg.solve((through * prior) @ through.T + noise, through).T
        mean = gain @ pulled
        covariance = np.diag(prior) - gain @ (through * prior)
        before = variance.copy()
        squares = mean**2 + np.diag(covariance)
        for group in range(1, len(variance)):
            mine = squares[groups.group == group]
            usual = _USUAL_WEIGHT * groups.usual[group]
            one = (mine.sum() + usual) / (len(mine) + _USUAL_WEIGHT)
            variance[group] = min(float(one), groups.largest[group])
        if np.allclose(variance, before, rtol=1e-3):
            break
    of_terms = groups.fields @ covariance @ groups.fields.T
    return FieldEstimate(groups.fields @ mean, 0.5 * (of_terms + of_terms.T), variance_px2)


def _held_out_noise(information: np.ndarray, pull: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the covariance (TERMS, TERMS) of the whole pull by cross-validation, and its usual variance.

    The pull of each block (B, TERMS) is predicted from the fields that all others show. What is missed tells
    the variance of residual components, in px^2: its mean over the directions that the measurements determine
    best, and at least that in each of the others, where slow changes of an image count most.
    """
    whole, pulled = information.sum(axis=0), pull.sum(axis=0)
    values, vectors = np.linalg.eigh(whole)
    ridge = max(_RIDGE * float(values[-1]), _TINY)
    values = np.maximum(values, ridge)
    squares, expected = [], []
    for own, own_pull in zip(information, pull, strict=True):
        spread = np.linalg.inv(whole - own + ridge * np.eye(len(values)))
        missed = vectors.T @ (own_pull - own @ (spread @ (pulled - own_pull)))
        squares.append(missed**2)
        covariance = own + own @ spread @ own
        expected.append(np.einsum("ij,ik,kj->j", vectors, covariance, vectors))
    missed_px2, unit = np.array(squares), np.maximum(expected, 1e-300)
    best = (values >= np.median(values)) & (unit > _RIDGE * np.max(unit))
    usual = float(np.mean((missed_px2 / unit)[best]))
    each = np.maximum(missed_px2.sum(axis=0) / unit.sum(axis=0), usual)
    return (vectors * (each * values)) @ vectors.T, usual
