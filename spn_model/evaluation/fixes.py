"""Fixes of a bundle on evaluation flights: each image compared with its label, and their figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import beta

from spn_data.errors import StageError
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotation_vectors
from spn_data.inputs.evaluation_flights import EvaluationFlight
from spn_model.evaluation.flight_attitude import FlightAttitude, attitude_of_flight
from spn_model.integrity.fix import Fix, FixSource, NoFix
from spn_model.landmarks.aids import KnownVertical
from spn_model.onboard.flight_report import longest_outage
from spn_model.onboard.localizer import Localizer
from spn_model.onboard.pilot import Pilot, PilotOptions

MISLEADING_M, MISLEADING_DEG = 0.5, 2.0
CONFIDENCE = 0.95
COARSE, SEARCH, TRACK = "coarse", "search", "track"
_FIRST_US = 1_000_000  # a time of zero is refused


@dataclass(frozen=True, kw_only=True)
class FixError:
    """Error of a pose that was published.

    Attributes
    ----------
    error_m, error_deg : float
        Distance and angle to the true pose.
    horizontal_m, vertical_m : float
        Parts of the distance.
    nees : float
        Squared error over the stated covariance, divided by 6: 1 on average if the covariance is right.
    is_protected : bool
        Whether both parts are within their protection levels.
    is_misleading : bool
        Whether it is off by more than 0.5 m or 2 degrees, or not protected.
    """

    error_m: float
    error_deg: float
    horizontal_m: float
    vertical_m: float
    nees: float
    is_protected: bool
    is_misleading: bool


@dataclass(frozen=True, kw_only=True)
class JudgedImage:
    """What was published about an image.

    Attributes
    ----------
    name : str
        Of the frame.
    time_s : float
        Since the first frame of the flight.
    is_usable : bool
    state, source : str
        As published; empty for coarse poses.
    reason : str
        Why there is no usable fix.
    protection_m : tuple of float
        Protection levels, horizontal and vertical; NaN without a usable fix, and for coarse poses.
    error : FixError or None
        None without a usable fix, or without a label to compare it with.
    pose : Poses or None
        The usable fix, one pose; None without.
    """

    name: str
    time_s: float
    is_usable: bool
    state: str = ""
    source: str = ""
    reason: str = ""
    protection_m: tuple[float, float] = (math.nan, math.nan)
    error: FixError | None = None
    pose: Poses | None = None


@dataclass(frozen=True, kw_only=True)
class FixSummary:
    """Figures of one way to localize the images of a flight.

    Attributes
    ----------
    images, usable : int
    compared : int
        Usable fixes of frames with a label; errors are of these.
    error_m, error_deg : float
        Medians; NaN without any.
    largest_m : float
        Largest position error.
    misleading : int
    misleading_at_most : float
        Upper bound of the share of misleading ones among usable fixes, at 95 % confidence (Clopper &
        Pearson 1934, one-sided; about 3/n for none of n). 1 without any.
    nees : float
        Mean of the squared errors over the stated covariances, divided by 6.
    protected : float
        Share with errors within the protection levels; NaN for coarse poses.
    longest_outage_s : float
        Longest time without a usable fix; NaN where images do not follow each other.
    from_network : int
        Usable fixes that were searched for around the pose of the network, not by landmarks alone.
    """

    images: int
    usable: int
    compared: int
    error_m: float
    error_deg: float
    largest_m: float
    misleading: int
    misleading_at_most: float
    nees: float
    protected: float
    longest_outage_s: float
    from_network: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightFixes:
    """All images of a flight, localized in one way.

    Attributes
    ----------
    flight : str
    method : str
        `COARSE`, `SEARCH` or `TRACK`.
    images : tuple of JudgedImage
    attitude : FlightAttitude or None
        That the images were localized with; None without one.
    """

    flight: str
    method: str
    images: tuple[JudgedImage, ...]
    attitude: FlightAttitude | None = None

    @property
    def row(self) -> str:
        """Name of the row in tables: the method, and whether an attitude helped."""
        if self.attitude is None:
            return self.method
        return f"{self.method}, {'simulated ' if self.attitude.is_simulated else ''}attitude"

    def summary(self) -> FixSummary:
        """Return the figures."""
        errors = [image.error for image in self.images if image.error is not None]
        misleading = sum(error.is_misleading for error in errors)
        return FixSummary(
            images=len(self.images),
            usable=sum(image.is_usable for image in self.images),
            compared=len(errors),
            error_m=_of(np.median, [error.error_m for error in errors]),
            error_deg=_of(np.median, [error.error_deg for error in errors]),
            largest_m=_of(np.max, [error.error_m for error in errors]),
            misleading=misleading,
            misleading_at_most=largest_share(misleading, len(errors)),
            nees=_of(np.mean, [error.nees for error in errors]),
            protected=math.nan
            if self.method == COARSE
            else _of(np.mean, [float(error.is_protected) for error in errors]),
            longest_outage_s=longest_outage(
                [image.time_s for image in self.images], [image.is_usable for image in self.images]
            )
            if self.method == TRACK
            else math.nan,
            from_network=sum(image.source == FixSource.NETWORK.value for image in self.images),
        )


def fix_error(fix: Fix, truth: Poses) -> FixError:
    """Return the error of a fix against one true pose."""
    levels = (fix.horizontal_protection_m, fix.vertical_protection_m)
    return _error(_pose(fix), fix.covariance, levels, truth)


def _pose(fix: Fix) -> Poses:
    return Poses(fix.center[None], fix.quat_wxyz[None])


def largest_share(events: int, of: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper bound of a share of which `events` of `of` were seen (Clopper & Pearson 1934)."""
    return 1.0 if events >= of else float(beta.ppf(confidence, events + 1, of - events))


def search_each(
    pilot: Pilot,
    flight: EvaluationFlight,
    done: Callable[[], None],
    attitude: FlightAttitude | None = None,
) -> FlightFixes:
    """Search for each chosen frame of a flight that has a label, alone.

    Parameters
    ----------
    pilot : Pilot
        Without a sequence.
    flight : EvaluationFlight
    done : callable
        Called after each image.
    attitude : FlightAttitude, optional

    Returns
    -------
    FlightFixes
    """
    judged = []
    for row, image in flight.images(chosen_rows(flight)):
        judged.append(_judged(pilot.fix(image, _FIRST_US, _up(attitude, row)), flight, row))
        done()
    return FlightFixes(flight=flight.name, method=SEARCH, images=tuple(judged), attitude=attitude)


def track_all(
    pilot: Pilot,
    flight: EvaluationFlight,
    done: Callable[[], None],
    attitude: FlightAttitude | None = None,
) -> FlightFixes:
    """Localize all frames of a flight, one after the other, as in flight.

    Parameters
    ----------
    pilot : Pilot
        For a sequence.
    flight : EvaluationFlight
        With increasing times, see `has_times`.
    done : callable
        Called after each image.
    attitude : FlightAttitude, optional

    Returns
    -------
    FlightFixes
    """
    judged = []
    for row, image in flight.images(np.arange(len(flight.labels))):
        time_us = _FIRST_US + round(1e6 * float(flight.labels.time_s[row]))
        item = pilot.fix(image, time_us, _up(attitude, row))
        judged.append(_judged(item, flight, row))
        done()
    return FlightFixes(flight=flight.name, method=TRACK, images=tuple(judged), attitude=attitude)


def coarse_each(
    localizer: Localizer,
    flight: EvaluationFlight,
    done: Callable[[], None],
    attitude: FlightAttitude | None = None,
) -> FlightFixes:
    """Let the network of a bundle alone estimate the pose of each chosen frame that has a label."""
    judged = []
    for row, image in flight.images(chosen_rows(flight)):
        found = localizer.localize(image, flight.camera, vertical=_up(attitude, row))
        truth = flight.labels.poses[row : row + 1]
        judged.append(
            JudgedImage(
                name=str(flight.labels.names[row]),
                time_s=float(flight.labels.time_s[row]),
                is_usable=not found.reason,
                reason=found.reason,
                error=None
                if found.reason
                else _error(found.poses, found.covariance, (math.inf, math.inf), truth),
                pose=None if found.reason else found.poses,
            )
        )
        done()
    return FlightFixes(flight=flight.name, method=COARSE, images=tuple(judged), attitude=attitude)


def measure_flight(
    bundle: Path, flight: EvaluationFlight, done: Callable[[], None], *, attitude: bool = True
) -> tuple[tuple[FlightFixes, ...], str]:
    """Localize the images of a flight with a bundle in each way: coarse, search, track.

    Parameters
    ----------
    bundle : Path
        Folder of a bundle with landmarks.
    flight : EvaluationFlight
    done : callable
        Called after each image, `steps_of` times.
    attitude : bool
        Whether to localize them a second time in each way, with a known attitude.

    Returns
    -------
    fixes : tuple of FlightFixes
        Without `TRACK` if the images have no increasing times, or the video is not found.
    note : str
        Why `TRACK` is missing; empty otherwise.

    Raises
    ------
    InputError, FormatError
        If bundle or images cannot be used.
    """
    pilot = Pilot(bundle, flight.camera, PilotOptions(sequence=False))
    gimbal = pilot.localizer.bundle.gimbal
    given = [None, *([attitude_of_flight(flight, gimbal)] if attitude else [])]
    found: list[FlightFixes] = []
    note = "its images have no increasing times"
    for one in given:
        found += [
            coarse_each(pilot.localizer, flight, done, one),
            search_each(pilot, flight, done, one),
        ]
        if has_times(flight):
            try:
                found.append(track_all(Pilot(bundle, flight.camera), flight, done, one))
                note = ""
            except StageError as error:  # the video of tracked frames
                note = str(error)
    return tuple(found), note and f"{flight.name} was not tracked: {note}"


def steps_of(flight: EvaluationFlight, *, attitude: bool = True) -> int:
    """Return how many images `measure_flight` localizes."""
    once = 2 * len(chosen_rows(flight)) + len(flight.labels) * has_times(flight)
    return once * (2 if attitude else 1)


def chosen_rows(flight: EvaluationFlight) -> np.ndarray:
    """Return the rows of chosen frames with a label."""
    return np.flatnonzero(flight.labels.registered & ~flight.labels.tracked)


def has_times(flight: EvaluationFlight) -> bool:
    """Return whether the images of a flight follow each other in time."""
    times = np.round(1e6 * flight.labels.time_s)
    return bool(np.isfinite(times).all() and (np.diff(times) > 0).all())


def _up(attitude: FlightAttitude | None, row: int) -> KnownVertical | None:
    return None if attitude is None else attitude.verticals[row]


def _judged(item: Fix | NoFix, flight: EvaluationFlight, row: int) -> JudgedImage:
    labels = flight.labels
    name, time_s, state = str(labels.names[row]), float(labels.time_s[row]), item.state.value
    if isinstance(item, NoFix) or not item.usable:
        return JudgedImage(
            name=name, time_s=time_s, is_usable=False, state=state, reason=item.reason
        )
    return JudgedImage(
        name=name,
        time_s=time_s,
        is_usable=True,
        state=state,
        source=item.source.value,
        protection_m=(item.horizontal_protection_m, item.vertical_protection_m),
        error=fix_error(item, labels.poses[row : row + 1]) if labels.registered[row] else None,
        pose=_pose(item),
    )


def _error(
    pose: Poses, covariance: np.ndarray, levels_m: tuple[float, float], truth: Poses
) -> FixError:
    error_m, error_deg = (float(value[0]) for value in pose_errors(pose, truth))
    off = truth.centers[0] - pose.centers[0]
    turn = rotation_vectors(truth.rotations @ pose.rotations.transpose(0, 2, 1))[0]
    both = np.concatenate([off, turn])
    horizontal_m, vertical_m = float(np.hypot(*off[:2])), float(abs(off[2]))
    is_protected = horizontal_m <= levels_m[0] and vertical_m <= levels_m[1]
    try:
        nees = float(both @ np.linalg.solve(covariance, both) / 6)
    except np.linalg.LinAlgError:  # a network may state any covariance
        nees = math.nan
    return FixError(
        error_m=error_m,
        error_deg=error_deg,
        horizontal_m=horizontal_m,
        vertical_m=vertical_m,
        nees=nees,
        is_protected=is_protected,
        is_misleading=error_m > MISLEADING_M or error_deg > MISLEADING_DEG or not is_protected,
    )


def _of(figure: Callable[[np.ndarray], np.floating], values: Sequence[float]) -> float:
    return float(figure(np.array(values))) if values else math.nan
