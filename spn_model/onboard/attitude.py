"""Attitude of a flight: pitch and roll over time from a CSV file, as the direction of up in the camera."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.json_values import bounded, numbers
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.received_attitude import ReceivedAttitude
from spn_model.landmarks.aids import KnownVertical
from spn_model.onboard.telemetry_file import MAX_TIME_S, between, read_columns
from spn_model.onboard.view import View

GIMBAL, CAMERA, BODY = "gimbal", "camera", "body"  # whose angles a file states
MAX_TURN_DEG = 10.0  # of a mounting
MIN_SIGMA_DEG, MAX_SIGMA_DEG = 1e-3, 45.0
_PITCH, _ROLL, _SIGMA = "pitch_deg", "roll_deg", "sigma_deg"


@dataclass(frozen=True, kw_only=True)
class GimbalMounting:
    """How the camera is turned from what the gimbal's angles say, measured on the mapping flights.

    Attributes
    ----------
    turn_deg : tuple of float
        Rotation vector in the camera frame, from the stated camera to the true one, degrees.
    sigma_deg : float
        Standard deviation of up from the angles after that rotation, along each of two axes.
    frames, flights : int
        That it was measured on.
    """

    turn_deg: tuple[float, float, float]
    sigma_deg: float
    frames: int
    flights: int

    @property
    def rotation(self) -> np.ndarray:
        """Rotation (3, 3) from the stated to the true camera."""
        return rotations_from_vectors(np.deg2rad([self.turn_deg]))[0]

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**asdict(self), "turn_deg": list(self.turn_deg)}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> GimbalMounting:
        """Parse the result of `to_json`; raise KeyError, TypeError or ValueError if invalid."""
        x, y, z = numbers(value["turn_deg"], 3).tolist()
        if math.hypot(x, y, z) > MAX_TURN_DEG:
            raise ValueError(f"its gimbal is turned by {value['turn_deg']} deg")
        return cls(
            turn_deg=(x, y, z),
            sigma_deg=bounded(value["sigma_deg"], MIN_SIGMA_DEG, MAX_SIGMA_DEG),
            frames=int(bounded(value["frames"], 1, 1e9)),
            flights=int(bounded(value["flights"], 1, 1e6)),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Attitude:
    """Up in the camera at N times.

    Attributes
    ----------
    time_s : ndarray, shape (N,)
        On the clock of the images, increasing.
    up : ndarray, shape (N, 3)
        Unit vectors in the camera frame.
    sigma_deg : ndarray, shape (N,)
    is_corrected : bool
        Whether the mounting of a gimbal was applied.
    """

    time_s: np.ndarray
    up: np.ndarray
    sigma_deg: np.ndarray
    is_corrected: bool = False

    def coverage(self, known: int, images: int) -> str:
        """Return a sentence on how many images the attitude is known for."""
        text = (
            f"Attitude: known for {known} of {images} images, to {np.median(self.sigma_deg):.2g} deg"
            f"{', corrected by the mounting of the gimbal' if self.is_corrected else ''}."
        )
        if known < images:
            first, last = self.time_s[[0, -1]]
            text += f" The file covers {first:.1f} to {last:.1f} s; see --attitude-offset."
        return text

    def at(self, time_s: float) -> KnownVertical | None:
        """Return up in the camera at a time; None outside the records, and in gaps of more than a second."""
        found = between(self.time_s, time_s)
        if found is None:
            return None
        k, share = found
        up = (1 - share) * self.up[k[0]] + share * self.up[k[1]]
        x, y, z = (up / np.linalg.norm(up)).tolist()
        return KnownVertical(up=(x, y, z), sigma_deg=float(self.sigma_deg[k].max()))


def read_attitude(
    path: Path,
    *,
    of: str,
    mounting: GimbalMounting | None,
    body_from_camera: np.ndarray,
    sigma_deg: float | None = None,
    offset_s: float = 0.0,
) -> Attitude:
    """Read pitch and roll from a CSV file.

    Parameters
    ----------
    path : Path
        With the columns time_s, pitch_deg and roll_deg, and sigma_deg if it states one; others are ignored,
        as are lines that begin with "#". A record without pitch or roll is none.
    of : str
        "gimbal", "camera" or "body": whose angles they are. Those of gimbal and camera are the camera's
        (`rotations_from_angles`), those of the body are an autopilot's.
    mounting : GimbalMounting or None
        Applied to the angles of a gimbal; None if it is not known.
    body_from_camera : ndarray, shape (3, 3)
        Rotation from camera to body axes, for the angles of the body.
    sigma_deg : float, optional
        Standard deviation of each angle, instead of that of the file or of the mounting.
    offset_s : float
        Added to the times of the file, to give times of the images.

    Returns
    -------
    Attitude

    Raises
    ------
    InputError
        If the file cannot be read, a value is none, or the standard deviation is not known.
    """
    _check_stated(sigma_deg, offset_s)
    rows = read_columns(
        path,
        {_PITCH: (-180, 180), _ROLL: (-180, 180)},
        {_SIGMA: (MIN_SIGMA_DEG, MAX_SIGMA_DEG)},
    )
    own = mounting if of == GIMBAL else None
    sigma = rows[:, 3]
    if sigma_deg is not None:
        sigma = np.full(len(rows), sigma_deg)
    elif own is not None:
        sigma = np.where(np.isfinite(sigma), sigma, own.sigma_deg)
    if not np.isfinite(sigma).all():
        raise InputError(
            f"states no {_SIGMA}, and the bundle knows none for these angles; give --attitude-sigma",
            path=path,
        )
    if of == BODY:
        up = _up_in_body(rows[:, 1], rows[:, 2]) @ body_from_camera
    else:
        angles = np.column_stack([np.zeros(len(rows)), rows[:, 1], rows[:, 2]])
        up = rotations_from_angles(angles)[:, :, 2]
        if own is not None:
            up = up @ own.rotation.T
    return Attitude(
        time_s=rows[:, 0] + offset_s, up=up, sigma_deg=sigma, is_corrected=own is not None
    )


def _check_stated(sigma_deg: float | None, offset_s: float) -> None:
    if sigma_deg is not None and not MIN_SIGMA_DEG <= sigma_deg <= MAX_SIGMA_DEG:
        raise InputError(
            f"--attitude-sigma {sigma_deg:g}: must be {MIN_SIGMA_DEG:g} to {MAX_SIGMA_DEG:g} degrees"
        )
    if not abs(offset_s) <= MAX_TIME_S:
        raise InputError(f"--attitude-offset {offset_s:g}: must be a number of seconds")


def _up_in_body(pitch_deg: np.ndarray, roll_deg: np.ndarray) -> np.ndarray:
    """Return up (N, 3) in body axes (forward, right, down)."""
    pitch, roll = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    return np.stack(
        [np.sin(pitch), -np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll)], axis=1
    )


class LiveAttitude:
    """Up in the camera while flying, from what an autopilot or its gimbal sends.

    Parameters
    ----------
    received : ReceivedAttitude
        Of the link to the autopilot.
    of : str
        "gimbal", "camera" or "body": whose angles they are.
    mounting : GimbalMounting or None
        Applied to the attitude of a gimbal; None if it is not known.
    body_from_camera : ndarray, shape (3, 3)
        Rotation from camera to body axes, for the attitude of the body.
    sigma_deg : float, optional
        Standard deviation of each angle, instead of that of the mounting.
    offset_s : float
        Added to the times of the messages, to give times of the images.

    Raises
    ------
    InputError
        If the standard deviation is not known, or a value is out of range.
    """

    def __init__(
        self,
        received: ReceivedAttitude,
        *,
        of: str,
        mounting: GimbalMounting | None,
        body_from_camera: np.ndarray,
        sigma_deg: float | None = None,
        offset_s: float = 0.0,
    ):
        _check_stated(sigma_deg, offset_s)
        own = mounting if of == GIMBAL else None
        if sigma_deg is None:
            if own is None:
                raise InputError(
                    "the bundle knows no standard deviation for the angles of --live-attitude; give "
                    "--attitude-sigma"
                )
            sigma_deg = own.sigma_deg
        self._received, self._offset_us = received, round(1e6 * offset_s)
        self._sigma_deg = sigma_deg
        self._camera_from_sender = (
            body_from_camera.T if of == BODY else Mounting().body_from_camera.T
        )
        if own is not None:
            self._camera_from_sender = own.rotation @ self._camera_from_sender

    def at(self, time_us: int) -> KnownVertical | None:
        """Return up in the camera at a time on the clock of the link; None if no message is near."""
        found = self._received.at(time_us - self._offset_us)
        if found is None:
            return None
        x, y, z = (self._camera_from_sender @ found[0]).tolist()
        return KnownVertical(up=(x, y, z), sigma_deg=math.hypot(self._sigma_deg, found[1]))

    def coverage(self, known: int, images: int) -> str:
        """Return a sentence on how many images the attitude is known for."""
        got = self._received
        text = f"Attitude: received for {known} of {images} images, {got.taken} messages."
        if got.refused:
            text += f" {got.refused} messages were refused, the last one because {got.reason}."
        return text


def attitude_of(
    given: argparse.Namespace,
    gimbal: GimbalMounting | None,
    view: View,
    body_from_camera: np.ndarray | None = None,
) -> Attitude | None:
    """Return the attitude that the options of a command line name, or None; see `read_attitude`."""
    if given.attitude is None:
        return None
    check_up(view, given.bundle)
    return read_attitude(
        given.attitude,
        of=given.attitude_of,
        mounting=gimbal,
        body_from_camera=np.eye(3) if body_from_camera is None else body_from_camera,
        sigma_deg=given.attitude_sigma,
        offset_s=given.attitude_offset,
    )


def check_up(view: View, path: Path) -> None:
    """Raise InputError, naming the network's file, if its world does not know up."""
    if not view.up_is_known:
        raise InputError(
            "its world does not know up, so an attitude says nothing in it; georeference the area, or leave "
            "out --attitude",
            path=path,
        )


def add_options(parser: argparse.ArgumentParser, kinds: tuple[str, ...]) -> None:
    """Add the options of a known attitude to a command line."""
    parser.add_argument("--attitude", type=Path, help="CSV file: time_s, pitch_deg, roll_deg")
    parser.add_argument(
        "--attitude-of",
        choices=kinds,
        default=GIMBAL,
        help="whose angles: of the gimbal, corrected by its mounting if the bundle knows that (default), of "
        "the camera itself" + (", or of the body" if BODY in kinds else ""),
    )
    parser.add_argument(
        "--attitude-sigma",
        type=float,
        metavar="DEG",
        help="standard deviation of each angle (default: of the file, or as measured on the mapping flights)",
    )
    parser.add_argument(
        "--attitude-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="added to the times of the file, to give times of the images",
    )
