"""Fix and NoFix: what is published about one image, checked so that nothing unusable gets out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from spn_data.errors import InputError

MAX_TIME_US = 2**63 - 1
MAX_REASON = 300
_UNIT_TOLERANCE = 1e-6
_SYMMETRY_TOLERANCE = 1e-9


class FixState(StrEnum):
    """State of the localization when an image was judged."""

    BOOT = "boot"  # no image was usable yet
    SEARCH = "search"  # poses are searched without a known position
    CONFIRM = "confirm"  # found, and not yet confirmed by further images
    TRACK = "track"  # predicted and confirmed by each image
    COAST = "coast"  # the last image gave nothing; motion alone continues the pose
    LOST = "lost"  # nothing agrees any more


class FixSource(StrEnum):
    """Where the hypothesis came from that won."""

    NETWORK = "network"
    RETRIEVAL = "retrieval"
    PRIOR = "prior"
    TRACK = "track"


# An autopilot gets poses of these states only; those of the others still wait for a second opinion.
USABLE_STATES = frozenset({FixState.TRACK, FixState.COAST})


@dataclass(frozen=True, eq=False, kw_only=True)
class Fix:
    """Pose of one image with all that a receiver has to know to use it.

    Attributes
    ----------
    time_us : int
        Middle of the exposure in microseconds, since 1970 (UTC) or since boot; > 0.
    center : ndarray, shape (3,)
        Camera centre in the world, in metres.
    quat_wxyz : ndarray, shape (4,)
        Unit quaternion, scalar first, from world axes to camera axes.
    covariance : ndarray, shape (6, 6)
        Over the centre (m, world axes) and a rotation vector v in the camera frame (rad):
        R_true = exp(v) R, as in dataset.h5.
    horizontal_protection_m, vertical_protection_m : float
        Protection levels: bounds of the error, > 0.
    state : FixState
        State of the localization.
    source : FixSource
        Where the winning hypothesis came from.
    quality : int
        1 (worst) to 100.
    processing_s : float
        Time from the end of the exposure to the construction of this object, >= 0.

    Raises
    ------
    InputError
        If a value is not finite, out of range or of another shape, if the quaternion has not length one, or
        if the covariance is not symmetric and positive definite; the message names the field and the value.
    """

    time_us: int
    center: np.ndarray
    quat_wxyz: np.ndarray
    covariance: np.ndarray
    horizontal_protection_m: float
    vertical_protection_m: float
    state: FixState
    source: FixSource
    quality: int
    processing_s: float

    def __post_init__(self) -> None:
        _check_time(self.time_us)
        _check_member("state", self.state, FixState)
        _check_member("source", self.source, FixSource)
        center = _array("center", self.center, (3,))
        quat = _array("quat_wxyz", self.quat_wxyz, (4,))
        length = float(np.linalg.norm(quat))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise InputError(f"a fix has the length {length:.9g} of quat_wxyz, not 1")
        covariance = _covariance(self.covariance)
        for name in ("horizontal_protection_m", "vertical_protection_m"):
            _check_number(name, getattr(self, name), lowest=0, open_end=True)
        _check_number("processing_s", self.processing_s, lowest=0)
        if not _whole(self.quality) or not 1 <= self.quality <= 100:
            raise InputError(
                f"a fix has the quality {self.quality!r}, not a whole number of 1 to 100"
            )
        for value in (center, quat, covariance):
            value.flags.writeable = False
        _store(
            self,
            time_us=int(self.time_us),
            center=center,
            quat_wxyz=quat,
            covariance=covariance,
            horizontal_protection_m=float(self.horizontal_protection_m),
            vertical_protection_m=float(self.vertical_protection_m),
            quality=int(self.quality),
            processing_s=float(self.processing_s),
        )

    @property
    def usable(self) -> bool:
        """Whether the state is one in which an autopilot may get the pose."""
        return self.state in USABLE_STATES

    @property
    def reason(self) -> str:
        """Why an autopilot may not get the pose; empty if it may."""
        return "" if self.usable else "waits for images that agree"

    @property
    def horizontal_sigma_m(self) -> float:
        """Standard deviation along the worst horizontal direction, in metres."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[:2, :2])[-1]))

    @property
    def vertical_sigma_m(self) -> float:
        """Standard deviation of the height, in metres."""
        return math.sqrt(float(self.covariance[2, 2]))


@dataclass(frozen=True, kw_only=True)
class NoFix:
    """An image without a usable pose, and why.

    Attributes
    ----------
    time_us : int
        Middle of the exposure in microseconds, since 1970 (UTC) or since boot; > 0.
    state : FixState
        State of the localization.
    reason : str
        One sentence, not empty, on one line.
    processing_s : float
        Time from the end of the exposure to the construction of this object, >= 0.

    Raises
    ------
    InputError
        If a value is not finite or out of range, or the reason is empty; the message names the field.
    """

    time_us: int
    state: FixState
    reason: str
    processing_s: float

    def __post_init__(self) -> None:
        _check_time(self.time_us)
        _check_member("state", self.state, FixState)
        _check_number("processing_s", self.processing_s, lowest=0)
        if (
            not isinstance(self.reason, str)
            or not self.reason.strip()
            or not self.reason.isprintable()
            or len(self.reason) > MAX_REASON
        ):
            raise InputError(
                f"a fix has the reason {self.reason!r}, not one line of 1 to {MAX_REASON} characters"
            )
        _store(self, time_us=int(self.time_us), processing_s=float(self.processing_s))


def _store(frozen: Fix | NoFix, **values: Any) -> None:
    """Set checked values: NumPy's scalars become plain numbers, and arrays copies that nobody can change."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)


def _check_time(value: Any) -> None:
    if not _whole(value) or not 0 < value <= MAX_TIME_US:
        raise InputError(f"a fix has the time_us {value!r}, not a whole number of microseconds > 0")


def _check_member(name: str, value: Any, kind: type[StrEnum]) -> None:
    if not isinstance(value, kind):
        raise InputError(f"a fix has the {name} {value!r}, not a {kind.__name__}")


def _check_number(name: str, value: Any, *, lowest: float, open_end: bool = False) -> None:
    """Refuse anything but a finite number >= lowest, or > lowest with an open end."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"a fix has the {name} {value!r}, not a number")
    if not math.isfinite(value) or value < lowest or (open_end and value == lowest):
        raise InputError(
            f"a fix has the {name} {value!r}, not {'>' if open_end else '>='} {lowest:g}"
        )


def _whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy in float64; refuse another shape or a value that is not finite."""
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"a fix has the {name} {value!r}, not numbers of shape {shape}") from error
    if found.shape != shape:
        raise InputError(f"a fix has a {name} of shape {found.shape}, not {shape}")
    if not np.isfinite(found).all():
        raise InputError(f"a fix has the {name} {found.tolist()}: not finite")
    return found


def _covariance(value: Any) -> np.ndarray:
    """Return a copy of a covariance, exactly symmetric; refuse one that gives no variance in a direction."""
    found = _array("covariance", value, (6, 6))
    diagonal = np.diagonal(found)
    if not (diagonal > 0).all():
        raise InputError(
            f"a fix has the covariance diagonal {diagonal.tolist()}: a value without variance"
        )
    sigma = np.sqrt(diagonal)
    correlation = found / np.outer(
        sigma, sigma
    )  # of one unit, so that one tolerance fits metres and radians
    if np.abs(correlation - correlation.T).max() > _SYMMETRY_TOLERANCE:
        raise InputError("a fix has a covariance that is not symmetric")
    smallest = float(np.linalg.eigvalsh((correlation + correlation.T) / 2)[0])
    if smallest <= 1e-12:
        raise InputError(
            "a fix has a covariance that is not positive definite: "
            f"its correlations have the eigenvalue {smallest:.3g}"
        )
    return (found + found.T) / 2
