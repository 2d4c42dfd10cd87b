"""Zero of a barometer, learnt from fixes."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_model.integrity.height import HeightErrors, HeightZero

ERRORS = HeightErrors(sigma_m=0.5, zero_m=3.0, drift_m=0.05)


def test_fixes_tell_the_zero():
    """After a minute of fixes a zero that is 2 m off is known to tenths; before, only as stated."""
    zero, rng = HeightZero(ERRORS), np.random.default_rng(0)
    assert zero.expected(10.0, 1) == (10.0, pytest.approx(np.hypot(3.0, 0.5)))
    for k in range(300):
        up_m = 10.0 + np.sin(k / 30)
        zero.learn(up_m - 2.0 + rng.normal(0, 0.5), k * 200_000, up_m, 0.02)
    up_m, sigma_m = zero.expected(10.0, 300 * 200_000)
    assert abs(up_m - 12.0) < 3 * sigma_m
    assert 0.5 < sigma_m < 0.6


def test_what_was_learnt_ages_and_can_be_forgotten():
    """An hour without a fix makes the zero as uncertain as a drift of an hour; a reset starts again."""
    zero = HeightZero(ERRORS)
    zero.learn(8.0, 0, 10.0, 0.02)
    _, sigma_m = zero.expected(8.0, 3_600_000_000)
    assert sigma_m == pytest.approx(np.sqrt(0.05**2 * 3600 + zero.variance + 0.25))
    zero.reset()
    assert zero.expected(8.0, 3_600_000_000) == (8.0, pytest.approx(np.hypot(3.0, 0.5)))


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), 1001.0])
def test_errors_have_bounds(value):
    """A standard deviation that is none is refused, with its name."""
    with pytest.raises(InputError, match="sigma_m of the height is"):
        HeightErrors(sigma_m=value)
