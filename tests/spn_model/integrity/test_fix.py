"""Fix and NoFix: what is refused at construction, and the standard deviations that they state."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_model.integrity.fix import Fix, FixSource, FixState, NoFix

GOOD = {
    "time_us": 1_700_000_000_000_000,
    "center": np.array([10.0, 20.0, 30.0]),
    "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0]),
    "covariance": np.diag([0.04, 0.01, 0.09, 1e-4, 1e-4, 1e-4]),
    "horizontal_protection_m": 0.9,
    "vertical_protection_m": 1.2,
    "state": FixState.TRACK,
    "source": FixSource.NETWORK,
    "quality": 80,
    "processing_s": 0.1,
}
NAN, INF = float("nan"), float("inf")


def _without_variance(index: int) -> np.ndarray:
    covariance = GOOD["covariance"].copy()
    covariance[index, index] = 0
    return covariance


def _correlated(value: float, other: float) -> np.ndarray:
    covariance = GOOD["covariance"].copy()
    covariance[0, 1], covariance[1, 0] = value, other
    return covariance


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("time_us", 0, "time_us 0"),
        ("time_us", -5, "time_us -5"),
        ("time_us", 1.5e15, "time_us 1500000000000000.0"),
        ("time_us", True, "time_us True"),
        ("time_us", 2**63, "time_us 9223372036854775808"),
        ("center", [1.0, NAN, 2.0], r"center \[1.0, nan, 2.0\]"),
        ("center", [1.0, 2.0], r"center of shape \(2,\)"),
        ("center", "here", "center 'here'"),
        ("center", [1 + 1j, 0, 0], "center"),
        ("quat_wxyz", [1.0, 0.1, 0.0, 0.0], "length 1.00498756 of quat_wxyz"),
        ("quat_wxyz", [0.0, 0.0, 0.0, 0.0], "length 0 of quat_wxyz"),
        ("quat_wxyz", [NAN, 0.0, 0.0, 1.0], "quat_wxyz .*not finite"),
        ("covariance", np.eye(3), r"covariance of shape \(3, 3\)"),
        ("covariance", np.full((6, 6), NAN), "covariance .*not finite"),
        ("covariance", _without_variance(2), "without variance"),
        ("covariance", _without_variance(5), "without variance"),
        ("covariance", -np.eye(6), "without variance"),
        ("covariance", _correlated(0.02, 0.02), "not positive definite.*eigenvalue"),
        ("covariance", _correlated(0.03, 0.03), "not positive definite.*eigenvalue -0.5"),
        ("covariance", _correlated(0.01, 0.0), "not symmetric"),
        ("horizontal_protection_m", 0.0, "horizontal_protection_m 0.0"),
        ("horizontal_protection_m", INF, "horizontal_protection_m inf"),
        ("vertical_protection_m", NAN, "vertical_protection_m nan"),
        ("vertical_protection_m", None, "vertical_protection_m None"),
        ("state", "track", "state 'track'"),
        ("source", "network", "source 'network'"),
        ("quality", 0, "quality 0"),
        ("quality", 101, "quality 101"),
        ("quality", 50.0, "quality 50.0"),
        ("processing_s", -0.1, "processing_s -0.1"),
        ("processing_s", NAN, "processing_s nan"),
    ],
)
def test_a_fix_refuses_what_nobody_can_use(field, value, said):
    """A wrong value of one field is refused with a line that names the field and the value."""
    with pytest.raises(InputError, match=said):
        Fix(**{**GOOD, field: value})


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("time_us", 0, "time_us 0"),
        ("state", None, "state None"),
        ("reason", "", "reason ''"),
        ("reason", " ", "reason ' '"),
        ("reason", "two\nlines", "reason"),
        ("reason", "x" * 301, "reason"),
        ("processing_s", NAN, "processing_s nan"),
    ],
)
def test_no_fix_always_has_a_reason(field, value, said):
    """A missing fix without time, state or reason is refused."""
    good = {
        "time_us": 5,
        "state": FixState.SEARCH,
        "reason": "too few inliers",
        "processing_s": 0.0,
    }
    assert NoFix(**good).reason == "too few inliers"
    with pytest.raises(InputError, match=said):
        NoFix(**{**good, field: value})


def test_what_a_fix_holds_cannot_change():
    """A fix keeps copies: neither the caller's arrays nor its own fields change it later."""
    center = GOOD["center"].copy()
    fix = Fix(**{**GOOD, "center": center})
    center[0] = 99
    assert fix.center[0] == 10
    with pytest.raises(ValueError, match="read-only"):
        fix.center[0] = 1
    with pytest.raises(AttributeError):
        fix.quality = 1


def test_numpy_scalars_become_plain_numbers():
    """Values of NumPy's types are accepted and stored as Python's, which JSON can write."""
    fix = Fix(
        **{**GOOD, "time_us": np.int64(7), "quality": np.int32(3), "processing_s": np.float32(0.5)}
    )
    assert (type(fix.time_us), type(fix.quality), type(fix.processing_s)) == (int, int, float)


def test_the_horizontal_sigma_is_that_of_the_worst_direction():
    """Turning the covariance about the vertical changes neither standard deviation."""
    for angle in (0.0, 0.4, 1.9):
        turn = np.eye(6)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        fix = Fix(**{**GOOD, "covariance": turn @ GOOD["covariance"] @ turn.T})
        assert fix.horizontal_sigma_m == pytest.approx(0.2)
        assert fix.vertical_sigma_m == pytest.approx(0.3)
