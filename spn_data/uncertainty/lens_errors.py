"""Errors of a lens that its parameters do not describe: smooth fields of displacements over the image.

A camera model with a focal length and two radial terms fits a real lens only approximately. What is left is a
smooth field over the image, the same in every frame. Bundle adjustment explains a part of it by wrong poses
and intrinsics, and the part that remains shows in the residuals: their mean in a cell of the image is not
zero. Its size is measured there, and a random field of that size is propagated to the unknowns.
"""

from __future__ import annotations

import numpy as np

from spn_data.geometry.camera import Camera

_DEGREE = 5  # of the polynomials: a thin-prism or decentring error has degree 2, a fifth-order radial one 5
_CELLS = (16, 12)  # across and down the image
_MIN_MEASUREMENTS = 20  # in each half of a cell
_SPLITS = 4  # random halves to average over


def field_values(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the basis of the fields at some pixels.

    Parameters
    ----------
    camera : Camera
        Only its image size matters.
    pixels : ndarray, shape (M, 2)

    Returns
    -------
    ndarray, shape (M, B)
        Products of Legendre polynomials in x and y up to degree 5, without the constant one, which is a shift
        of the principal point. Their mean square over the image is 1. Each serves both components.
    """
    across, down = (_legendre(v) for v in (2 * pixels / [camera.width, camera.height] - 1).T)
    values = [
        across[i] * down[j] for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i) if i + j > 0
    ]
    return np.stack(values, axis=1)


def _legendre(x: np.ndarray) -> list[np.ndarray]:
    """Return Legendre polynomials of mean square 1 over -1..1."""
    values = np.polynomial.legendre.legvander(x, _DEGREE)
    return list((values * np.sqrt(2 * np.arange(_DEGREE + 1) + 1)).T)


def field_px(
    camera: Camera, pixels: np.ndarray, residuals_px: np.ndarray, cluster: np.ndarray
) -> float:
    """Measure the size of a lens's field from the mean residuals of the cells of its image.

    Parameters
    ----------
    camera : Camera
    pixels, residuals_px : ndarray, shape (M, 2)
        Measurements with this lens.
    cluster : ndarray, shape (M,)
        Measurements of one cluster have dependent errors.

    Returns
    -------
    float
        Standard deviation of one component of the field in px; 0 if there is no sign of one.

    Notes
    -----
    Clusters are split into two random halves. The product of a cell's mean in one half and in the other is an
    unbiased estimate of the square of its field: chance does not repeat itself.
    """
    across, down = _CELLS
    scaled = pixels / [camera.width, camera.height] * _CELLS
    column, row = np.clip(scaled.astype(np.int64), 0, [across - 1, down - 1]).T
    cell = column * down + row
    generator = np.random.default_rng(0)
    squares = []
    for _ in range(_SPLITS):
        half = generator.random(int(cluster.max(initial=0)) + 1)[cluster] < 0.5
        counts, sums = [], []
        for mine in (half, ~half):
            counts.append(np.bincount(cell[mine], minlength=across * down))
            sums.append(
                [
                    np.bincount(cell[mine], residuals_px[mine, k], minlength=across * down)
                    for k in (0, 1)
                ]
            )
        enough = np.minimum(*counts) >= _MIN_MEASUREMENTS
        if not enough.any():
            return 0.0
        means = [
            np.array(total)[:, enough] / count[enough]
            for total, count in zip(sums, counts, strict=True)
        ]
        weight = (counts[0] + counts[1])[enough]
        squares.append(float((weight * (means[0] * means[1]).mean(axis=0)).sum() / weight.sum()))
    return float(np.sqrt(max(np.mean(squares), 0.0)))
