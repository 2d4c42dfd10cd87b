"""Tests of bundle adjustment of bent surveys, with exact ground truth."""

from __future__ import annotations

import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.adjust import adjust
from spn_data.colmap.clean import drop_out_of_view
from tests.worlds.survey_world import HEIGHT_M, error_m, survey


@pytest.fixture(scope="module")
def unbent_m() -> float:
    """Return the position error due to noise alone, adjusting from the true model."""
    model, centers = survey(0.0)
    assert error_m(model, centers) < 1e-9
    adjust(model, refine_principal_point=False, threads=2)
    return error_m(model, centers)


@pytest.mark.parametrize("sag_m", [3.0, 10.0])
def test_a_bent_survey_is_straightened_as_far_as_noise_lets_it(
    unbent_m: float, sag_m: float
) -> None:
    """A bent survey is straightened to the noise level, and few correct observations are dropped."""
    model, centers = survey(sag_m)
    before = error_m(model, centers)
    assert before > 0.5
    assert adjust(model, refine_principal_point=False, threads=2) < 10
    assert 0.01 < error_m(model, centers) < 1.15 * unbent_m


def test_wrong_measurements_are_found_in_a_bent_survey(unbent_m: float) -> None:
    """Most of 300 wrong observations in a bent survey are dropped."""
    model, centers = survey(3.0, wrong=300)
    dropped = adjust(model, refine_principal_point=False, threads=2)
    assert 270 < dropped < 600
    assert error_m(model, centers) < 1.3 * unbent_m


def test_a_step_that_leaves_all_behind_the_cameras_is_not_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A step that puts all points behind the cameras (at zero cost) is rejected and damped."""
    adjustment, radii = pycolmap.bundle_adjustment, []

    def overshoot_first(
        model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions
    ) -> None:
        radii.append(options.ceres.solver_options.initial_trust_region_radius)
        if len(radii) > 1:
            adjustment(model, options)
            return
        for frame in model.frames.values():
            pose = frame.rig_from_world
            frame.rig_from_world = pycolmap.Rigid3d(
                pose.rotation, pose.translation - [0, 0, 3 * HEIGHT_M]
            )

    monkeypatch.setattr(pycolmap, "bundle_adjustment", overshoot_first)
    model, _ = survey(3.0)
    adjust(model, refine_principal_point=False, threads=2)
    assert radii[0] > radii[1] == 1e4
    assert drop_out_of_view(model) == 0
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 0.4
