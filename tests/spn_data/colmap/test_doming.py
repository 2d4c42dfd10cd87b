"""Tests of removing doming from surveys by camera positions, with exact ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.colmap import doming, pycolmap
from spn_data.colmap.doming import correct_doming
from tests.worlds.survey_world import error_m, survey

_LINES = 12  # 480 images


@pytest.fixture(autouse=True)
def _enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lower the required number of positions, because a thousand images would take a minute."""
    monkeypatch.setattr(doming, "_MIN_POSITIONS", 400)


def fixes(centers: np.ndarray, sigma_m: float = 0.8) -> dict[str, list[float]]:
    """Return noisy positions by name, rotated and shifted as the world is against the model."""
    rng = np.random.default_rng(1)
    noisy = centers + rng.normal(0, sigma_m, centers.shape)
    turned = noisy @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T + [300, 200, 50]
    return {f"{i:03d}.jpg": row.tolist() for i, row in enumerate(turned)}


def geometry(model: pycolmap.Reconstruction) -> list[np.ndarray]:
    return [
        np.array([model.images[i].cam_from_world().matrix() for i in model.reg_image_ids()]),
        np.array([model.points3D[i].xyz for i in model.points3D]),
    ]


def reprojection_px(model: pycolmap.Reconstruction) -> float:
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def test_a_bend_is_taken_out_of_cameras_and_points_alike() -> None:
    """Doming is reduced from metres to decimetres, and reprojection errors hardly change."""
    model, centers = survey(15.0, lines=_LINES)
    before_m, before_px = error_m(model, centers), reprojection_px(model)
    bend_m = correct_doming(model, fixes(centers))
    assert before_m > 3
    assert bend_m == pytest.approx(before_m, rel=0.3)
    assert error_m(model, centers) < 0.6
    assert reprojection_px(model) < before_px + 0.3


def test_positions_that_are_wrong_do_not_bend_it() -> None:
    """Gross errors in 5 % of the positions do not disturb the correction."""
    model, centers = survey(15.0, lines=_LINES)
    positions = fixes(centers)
    for name in list(positions)[::20]:
        positions[name] = [5000.0, -3000.0, 800.0]
    assert correct_doming(model, positions) > 3
    assert error_m(model, centers) < 0.6


@pytest.mark.parametrize(
    ("sag_m", "lines", "given", "why"),
    [
        (0.0, _LINES, 480, "it is straight"),
        (6.0, _LINES, 480, "positions may be off by as much"),
        (15.0, _LINES, 300, "they are too few"),
        (30.0, 1, 480, "a line says nothing of its other side"),
    ],
)
def test_a_model_is_left_as_it_is_where(
    sag_m: float, lines: int, given: int, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model is unchanged if straight, or if positions are too noisy, too few or in one line."""
    if lines == 1:
        monkeypatch.setattr(doming, "_MIN_POSITIONS", 30)
    model, centers = survey(sag_m, lines=lines)
    before = geometry(model)
    positions = dict(list(fixes(centers).items())[:given])
    assert correct_doming(model, positions) == 0, why
    for one, other in zip(before, geometry(model), strict=True):
        assert np.array_equal(one, other)
