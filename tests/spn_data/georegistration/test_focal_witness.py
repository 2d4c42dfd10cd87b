"""Focal lengths by the fixes of simulated flights whose model is stretched in height."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.geometry.pose import Poses
from spn_data.georegistration.focal_witness import FocalByFixes, focal_lengths_by_fixes
from spn_data.georegistration.georegister import fit_telemetry
from tests.spn_data.georegistration.test_georegister import STANDARD, Draw, draw

WRONG_PX = 20.0
FOCAL_PX = 500.0


def stretch(one: Draw) -> np.ndarray:
    """Return changes (N, 6) per pixel: heights over the ground in proportion to the focal length."""
    up = one.world_from_model.rotation[2]
    heights = (one.model.centers - one.model.centers.mean(axis=0)) @ up
    change = np.zeros((len(heights), 6))
    change[:, :3] = heights[:, None] * up / FOCAL_PX
    return change


def by_fixes(one: Draw, change: np.ndarray, others: np.ndarray, clock_s: float) -> FocalByFixes:
    """Estimate the focal length of a model that is wrong by WRONG_PX."""
    wrong = Poses.from_rotations(one.model.centers + WRONG_PX * change[:, :3], one.model.rotations)
    fitted = fit_telemetry(wrong, one.telemetry, one.sequence, one.time_s)
    clocks = dict.fromkeys(one.sequence, clock_s)
    found = focal_lengths_by_fixes(
        wrong, fitted, {"a": change}, others, {"a": 0.3 * FOCAL_PX}, clocks
    )
    return found["a"]


def test_a_focal_length_is_told_by_flights_at_two_heights_within_what_is_stated() -> None:
    """Over 4 draws of GNSS errors, the error is below 2 sigma, and sigma below a twentieth."""
    off, sigma = [], []
    for seed in range(4):
        one = draw(replace(STANDARD, seed=20 + seed))
        change = stretch(one)
        found = by_fixes(one, change, np.zeros((len(change), 6, 0)), 0.0)
        off.append((found.shift_px + WRONG_PX) / found.sigma_px)
        sigma.append(found.sigma_px)
    assert np.abs(off).max() < 2.0
    assert np.median(sigma) < 0.05 * FOCAL_PX


def test_an_error_of_the_lens_that_looks_alike_takes_the_word_from_the_fixes() -> None:
    """With an unknown lens error of the same effect, sigma is that of the prior."""
    one = draw()
    change = stretch(one)
    alike = by_fixes(one, change, 1e3 * change[:, :, None], 0.0)
    assert alike.sigma_px > 0.29 * FOCAL_PX


def test_an_unknown_clock_takes_the_word_from_the_fixes() -> None:
    """If the focal length moves the cameras along their path, sigma grows with that of the time offset."""
    one = draw()
    path = np.zeros((len(one.model), 6))
    later = 1e3 * (np.array(one.sequence) == one.sequence[-1])  # the second flight
    path[:, :3] = np.gradient(one.model.centers, one.time_s + later, axis=0)
    none = np.zeros((len(path), 6, 0))
    known, unknown = (by_fixes(one, 0.02 * path, none, clock_s).sigma_px for clock_s in (0.0, 3.0))
    assert unknown > 3 * known
