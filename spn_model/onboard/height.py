"""Height of a flight: what a barometer read over time, from a CSV file, in the heights of the world."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_model.integrity.height import HeightErrors
from spn_model.onboard.telemetry_file import MAX_TIME_S, between, read_columns
from spn_model.onboard.view import View

_READING = "rel_alt_m"
_MAX_M = 20_000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BarometerHeights:
    """Readings of a barometer at N times.

    Attributes
    ----------
    time_s : ndarray, shape (N,)
        On the clock of the images, increasing.
    up_m : ndarray, shape (N,)
        Up in the world, if the zero of the readings is as stated.
    """

    time_s: np.ndarray
    up_m: np.ndarray

    def at(self, time_s: float) -> float | None:
        """Return up at a time; None outside the records, and in gaps of more than a second."""
        found = between(self.time_s, time_s)
        if found is None:
            return None
        k, share = found
        return float((1 - share) * self.up_m[k[0]] + share * self.up_m[k[1]])


def read_heights(
    path: Path, origin: GeoOrigin, *, zero_m: float | None = None, offset_s: float = 0.0
) -> BarometerHeights:
    """Read heights above take-off from a CSV file.

    Parameters
    ----------
    path : Path
        With the columns time_s and rel_alt_m; others are ignored.
    origin : GeoOrigin
        Of the world.
    zero_m : float, optional
        Height of the place of take-off, above what the heights of the world count from. Needed unless they
        count from take-off too, which is then taken to be the same place.
    offset_s : float
        Added to the times of the file, to give times of the images.

    Returns
    -------
    BarometerHeights

    Raises
    ------
    InputError
        If the file cannot be read, or the two kinds of heights have nothing in common.
    """
    reference = origin.height_reference
    if reference == HeightReference.UNKNOWN:
        raise InputError(
            "--height needs a world that states what its heights count from, and this one does not",
            path=path,
        )
    if zero_m is None:
        if reference != HeightReference.TAKEOFF:
            raise InputError(
                f"its heights count from take-off, and those of the world from '{reference.value}'; give the "
                "height of the place of take-off above that with --height-zero",
                path=path,
            )
        zero_m = 0.0
    if not (abs(zero_m) <= _MAX_M and abs(offset_s) <= MAX_TIME_S):
        raise InputError(
            f"--height-zero {zero_m:g} or --height-offset {offset_s:g} is out of range"
        )
    rows = read_columns(path, {_READING: (-_MAX_M, _MAX_M)})
    return BarometerHeights(time_s=rows[:, 0] + offset_s, up_m=rows[:, 1] + zero_m - origin.alt_m)


def heights_of(given: argparse.Namespace, view: View) -> BarometerHeights | None:
    """Return the heights that the options of a command line name, or None; see `read_heights`."""
    if given.height is None:
        return None
    if view.origin is None:
        raise InputError(
            "its world has no place on the Earth, so a height says nothing in it; leave out --height",
            path=given.bundle,
        )
    return read_heights(
        given.height, view.origin, zero_m=given.height_zero, offset_s=given.height_offset
    )


def add_height_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a known height to a command line."""
    default = HeightErrors()
    parser.add_argument("--height", type=Path, help="CSV file: time_s, rel_alt_m (above take-off)")
    parser.add_argument(
        "--height-zero",
        type=float,
        metavar="M",
        help="of the place of take-off, above what heights of the world count from",
    )
    parser.add_argument(
        "--height-sigma",
        type=float,
        default=default.sigma_m,
        metavar="M",
        help=f"standard deviation of a reading (default {default.sigma_m:g})",
    )
    parser.add_argument(
        "--height-zero-sigma",
        type=float,
        default=default.zero_m,
        metavar="M",
        help=f"of its zero, before fixes tell it (default {default.zero_m:g})",
    )
    parser.add_argument(
        "--height-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="added to the times of the file, to give times of the images",
    )
