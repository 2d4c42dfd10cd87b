"""Changes of the poses of a map with its focal lengths, all else adjusted to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.least_squares import POSE
from spn_data.uncertainty.bundle_jacobians import Unknowns
from spn_data.uncertainty.shared_errors import HeldInverse, SharedErrors


@dataclass(frozen=True, eq=False)
class FocalChanges:
    """Linear changes of N poses, with axes and order of their covariances.

    Attributes
    ----------
    by_focal : dict of int to ndarray, shape (N, 6)
        Per pixel of the focal length of a camera, by its id, with the other focal lengths held.
    by_lens_errors : ndarray, shape (N, 6, t)
        By t independent errors of unit variance that lenses have besides, with all focal lengths held.
    """

    by_focal: dict[int, np.ndarray]
    by_lens_errors: np.ndarray


def focal_changes(
    inverse: HeldInverse, unknowns: Unknowns, shared: SharedErrors, frames: int
) -> FocalChanges:
    """Return how the poses of a map change with its focal lengths.

    Parameters
    ----------
    inverse : HeldInverse
        Inverse of the normal matrix.
    unknowns : Unknowns
    shared : SharedErrors
        Errors of the lenses.
    frames : int
        Number of frames N.

    Returns
    -------
    FocalChanges
    """
    rest = shared.unknowns
    by_focal = {}
    for camera_id, (own, change) in _by_focal(inverse, unknowns).items():
        rest = rest - change @ rest[own[:1]]
        by_focal[camera_id] = change[: POSE * frames, 0].reshape(frames, POSE)
    return FocalChanges(by_focal, rest[: POSE * frames].reshape(frames, POSE, -1))


def with_focal_errors(
    shared: SharedErrors,
    inverse: HeldInverse,
    unknowns: Unknowns,
    errors_px: Mapping[int, float],
) -> SharedErrors:
    """Add errors of focal lengths that something besides the images shows.

    Parameters
    ----------
    shared : SharedErrors
    inverse : HeldInverse
    unknowns : Unknowns
    errors_px : mapping of int to float
        Standard deviation by camera id.

    Returns
    -------
    SharedErrors
        The same with one error more for each of these cameras.
    """
    doubted = {i: px for i, px in errors_px.items() if px > 0 and i in unknowns.lens_columns}
    if not doubted:
        return shared
    changes = _by_focal(inverse, unknowns)
    more = [px * changes[camera_id][1] for camera_id, px in doubted.items()]
    together = np.concatenate([shared.unknowns, *more], axis=1)
    fields = {
        camera_id: np.pad(field, ((0, 0), (0, len(more))))
        for camera_id, field in shared.fields.items()
    }
    return SharedErrors(together, fields, shared.principal_points, shared.focal_lengths)


def _by_focal(inverse: HeldInverse, unknowns: Unknowns) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the columns of each focal length (f, or fx and fy), and the change (n, 1) per pixel of it."""
    columns = {
        i: own[(unknowns.lens_jacobian[i][:2] != 0).any(axis=0)]
        for i, own in unknowns.lens_columns.items()
    }
    every = np.unique(np.concatenate([inverse.held, *columns.values()])).astype(np.int64)
    fixed = HeldInverse.of(inverse.free, every)
    return {i: (own, fixed.change_by(own)) for i, own in columns.items()}
