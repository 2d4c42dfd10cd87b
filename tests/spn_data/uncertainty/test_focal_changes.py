"""Changes of a map with its focal length, against adjustments in which it is held."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Similarity
from spn_data.geometry.rotations import rotation_vectors
from spn_data.uncertainty.map_covariance import MapCovariance, MapCovarianceOptions
from spn_data.uncertainty.shared_errors import LensPrior
from tests.spn_data.uncertainty.test_lens_errors import lens_with, seen_through
from tests.spn_data.uncertainty.test_map_covariance import Small, adjusted


@cache
def made() -> Small:
    """Return a model of exact pixels' noisy copies, through a lens with a shifted principal point."""
    return seen_through(lens_with((3.0, 2.0)), seed=5)[1]


@cache
def told(focal_doubt_px: float = 0.0) -> MapCovariance:
    """Return its covariance."""
    options = MapCovarianceOptions(lenses={1: LensPrior(focal_doubt_px=focal_doubt_px)})
    return MapCovariance.of(made().scene, made().seen, options)


def test_poses_follow_a_focal_length_as_in_an_adjustment_that_holds_it() -> None:
    """Poses with the focal length held 5 px longer are predicted within a tenth of their change."""
    scene, seen = made().scene, made().seen
    change = told().focal_changes().by_focal[1]
    before = scene.cameras[1]
    params = before.params.copy()
    params[0] += 5.0
    longer = Camera(before.model, before.width, before.height, params)
    held = adjusted(replace(scene, cameras={1: longer}), seen, seen.pixels, hold_focal=True)
    back = Similarity.fit(held.scene.poses.centers, scene.poses.centers)
    found = back.apply_to_poses(held.scene.poses)
    moved = np.concatenate(
        [
            found.centers - scene.poses.centers,
            rotation_vectors(found.rotations @ np.swapaxes(scene.poses.rotations, 1, 2)),
        ],
        axis=1,
    )
    size = np.sqrt((moved**2).mean(axis=0))
    apart = np.sqrt(((moved - 5.0 * change) ** 2).mean(axis=0))
    assert np.linalg.norm(size[:3]) > 1e-3
    assert np.linalg.norm(apart[:3]) < 0.1 * np.linalg.norm(size[:3])
    assert np.linalg.norm(apart[3:]) < 0.1 * np.linalg.norm(size[3:])


def test_a_doubted_focal_length_is_in_the_covariance_of_poses() -> None:
    """A doubt of 7 px adds 49 times the products of the poses' changes, wherever it comes from."""
    change = told().focal_changes().by_focal[1]
    before = told().pose_covariances()
    expected = before + 49.0 * change[:, :, None] * change[:, None, :]
    later = told().with_focal_errors({1: 7.0}).pose_covariances()
    at_once = told(7.0).pose_covariances()
    scale = np.abs(expected).max()
    assert np.abs(later - expected).max() < 1e-6 * scale
    assert np.abs(at_once - expected).max() < 1e-6 * scale
    assert np.abs(before - expected).max() > 0.1 * scale


def test_other_errors_of_lenses_leave_the_focal_length_as_it_is() -> None:
    """What is taken out of each other error of the lenses is the change by the focal length alone."""
    changes = told().focal_changes()
    rest = changes.by_lens_errors
    whole = told().shared.unknowns[: 6 * len(rest)].reshape(rest.shape)
    taken = (whole - rest).reshape(-1, rest.shape[2])
    by_focal = changes.by_focal[1].ravel()
    assert np.linalg.norm(taken) > 0
    assert np.linalg.matrix_rank(np.column_stack([taken, by_focal]), tol=1e-9) == 1
