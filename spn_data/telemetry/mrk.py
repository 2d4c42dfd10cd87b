"""DJI's .MRK files: time, position and accuracy of each exposure of an RTK drone."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference, metres_from_first_fix
from spn_data.telemetry.drone_xmp import RTK_NONE, describe_rtk
from spn_data.telemetry.textfile import MAX_RECORDS, read_text
from spn_data.telemetry.track import Telemetry

_MAX_BYTES = 50_000_000
_GPS_EPOCH_S = 315_964_800.0  # 6 January 1980, in seconds since 1970
_WEEK_S = 604_800.0
_MAX_APART_M = 10.0  # the photo's own position may be of a single receiver
_SHIFTED_M = 0.5  # by which photos may be nearer to other exposures, in the median
_MORE_ACCURATE = 0.5  # of the stated standard deviation: post-processing rewrote the photo
_MAX_CLOCK_S = 2.5  # photos often state whole seconds
_LINE = re.compile(
    r"(?P<number>\d{1,6})\s+(?P<second>\d+(?:\.\d+)?)\s+\[(?P<week>\d{1,5})\]\s+"
    r"-?\d+\s*,\s*N\s+-?\d+\s*,\s*E\s+-?\d+\s*,\s*V\s+"
    r"(?P<lat>-?\d+\.\d+)\s*,\s*Lat\s+(?P<lon>-?\d+\.\d+)\s*,\s*Lon\s+"
    r"(?P<height>-?\d+(?:\.\d+)?)\s*,\s*Ellh\s+"
    r"(?P<north>\d+\.\d+)\s*,\s*(?P<east>\d+\.\d+)\s*,\s*(?P<up>\d+\.\d+)\s+(?P<flag>\d+)\s*,\s*Q",
    re.ASCII,
)
# The number ends the name, or letters of the lens follow: DJI_20250502142325_0031_D, 100_0004_0012.
_NUMBER = re.compile(r"(?:^|[^0-9])(\d{3,5})(?:_[A-Za-z]+)*$", re.ASCII)


@dataclass(frozen=True, eq=False)
class Exposures:
    """The N exposures of one file.

    Attributes
    ----------
    path : Path
        The file.
    number : ndarray, shape (N,) int
        Number of the photo in its flight.
    time_s : ndarray, shape (N,)
        Seconds since 1970 on a clock that may differ from UTC by the leap seconds.
    lat_lon_deg : ndarray, shape (N, 2)
        Position of the camera; NaN where there was none.
    height_m : ndarray, shape (N,)
        Its height above the ellipsoid.
    sigma_m : ndarray, shape (N, 3)
        Standard deviations east, north, up; NaN where not stated.
    flag : ndarray, shape (N,) int
        State of the receiver: 50 fixed, 34 float, 16 single, 0 none.
    """

    path: Path
    number: np.ndarray
    time_s: np.ndarray
    lat_lon_deg: np.ndarray
    height_m: np.ndarray
    sigma_m: np.ndarray
    flag: np.ndarray


def read_mrk(path: Path) -> Exposures:
    """Read a .MRK file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Exposures
        DJI's manuals state positions and heights after compensation: they are those of the sensor, so the
        offsets from the antenna, which are in the file too, must not be added again.

    Raises
    ------
    InputError
        If a line is not an exposure, or there is none.
    """
    rows: list[dict[str, float]] = []
    for number, line in enumerate(read_text(path, max_bytes=_MAX_BYTES).splitlines(), start=1):
        if not line.strip():
            continue
        found = _LINE.match(line.strip()[:1000])
        if found is None:
            raise InputError(
                "is not an exposure of DJI (number, GPS time, [week], N, E, V, Lat, Lon, Ellh, standard "
                f"deviations, Q): {line.strip()[:60]!r}",
                path=path,
                line=number,
            )
        if len(rows) >= MAX_RECORDS:
            raise InputError(f"has more than {MAX_RECORDS:,} lines", path=path)
        row = {name: float(value) for name, value in found.groupdict().items()}
        if abs(row["lat"]) > 90 or abs(row["lon"]) > 180 or row["second"] > _WEEK_S:
            raise InputError("states no position or time on Earth", path=path, line=number)
        rows.append(row)
    if not rows:
        raise InputError("holds no exposure", path=path)
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    flag = column["flag"].astype(np.int64)
    lat_lon = np.column_stack([column["lat"], column["lon"]])
    lat_lon[(flag == RTK_NONE) | ~lat_lon.any(axis=1)] = np.nan
    sigma = np.column_stack([column["east"], column["north"], column["up"]])
    sigma[~(sigma > 0).all(axis=1)] = np.nan
    return Exposures(
        path,
        column["number"].astype(np.int64),
        _GPS_EPOCH_S + _WEEK_S * column["week"] + column["second"],
        lat_lon,
        column["height"],
        sigma,
        flag,
    )


def with_exposures(
    photos: Telemetry, names: Sequence[str], files: Sequence[Exposures]
) -> Telemetry:
    """Give photos the positions of the .MRK files beside them.

    Parameters
    ----------
    photos : Telemetry
        One record per photo, N in all, from their own metadata.
    names : sequence of str, length N
        Names of the photos; their numbers are those of the exposures.
    files : sequence of Exposures
        Files in the folder of the photos; numbers start again in each.

    Returns
    -------
    Telemetry
        The same photos with positions, standard deviations and heights above the ellipsoid of their
        exposures. Photos without one keep their position, but lose their absolute height, which has another
        reference.

    Raises
    ------
    InputError
        If an exposure contradicts its photo in position or time, if no photo has an exposure, or if nothing
        in the photos can confirm that they belong together.
    """
    pairs = _pairs(photos, names, files)
    if not pairs:
        raise InputError(
            f"none of its {sum(len(f.number) for f in files)} exposures has the number of a photo "
            f"({names[0]}): {_REMEDY}",
            path=files[0].path.name,
        )
    _check_positions(photos, names, files, pairs)
    _check_times(photos, names, files, pairs)
    where = ", ".join(each.path.name for each in files)
    lat_lon, sigma = photos.lat_lon_deg.copy(), photos.sigma_m.copy()
    height = np.full(len(names), np.nan)
    flags: list[int | None] = []
    for row, (k, event) in pairs.items():
        exposure = files[k]
        if np.isnan(exposure.lat_lon_deg[event]).any():
            continue
        stated_m = np.hypot(*exposure.sigma_m[event, :2])
        if np.hypot(*sigma[row, :2]) < _MORE_ACCURATE * stated_m:
            note = (
                f"{where} is not used, as the photos state more accurate positions ({names[row]})"
            )
            return replace(photos, notes=(*photos.notes, note))
        lat_lon[row], height[row] = exposure.lat_lon_deg[event], exposure.height_m[event]
        sigma[row] = exposure.sigma_m[event]
        flags.append(int(exposure.flag[event]))
    note = (
        f"positions and heights above the ellipsoid of {len(flags)} of {len(names)} photos are from {where} "
        f"({describe_rtk(flags) or 'no RTK'})"
    )
    if len(flags) < len(names):
        note += "; the others have no absolute height"
    return replace(
        photos,
        lat_lon_deg=lat_lon,
        sigma_m=sigma,
        abs_alt_m=height,
        abs_reference=HeightReference.ELLIPSOID,
        notes=(*photos.notes, note),
    )


_REMEDY = (
    "it is of another flight, or the photos were renamed; move it away, or use --any-telemetry to go on "
    "without it"
)


def _pairs(
    photos: Telemetry, names: Sequence[str], files: Sequence[Exposures]
) -> dict[int, tuple[int, int]]:
    """Return (file, exposure) of photos by their number, the nearest one where several files have it."""
    by_number: dict[int, list[tuple[int, int]]] = {}
    for k, exposures in enumerate(files):
        for event, number in enumerate(exposures.number.tolist()):
            by_number.setdefault(number, []).append((k, event))
    pairs: dict[int, tuple[int, int]] = {}
    for row, name in enumerate(names):
        found = _NUMBER.search(Path(name).stem)
        choices = by_number.get(int(found[1]), []) if found else []
        if len(choices) > 1:
            apart = [_apart_m(photos.lat_lon_deg[row], files[k].lat_lon_deg[e]) for k, e in choices]
            if np.isnan(apart).all():
                raise InputError(
                    f"{name} has no position that decides to which of {len(choices)} exposures of its number "
                    f"it belongs: {_REMEDY}",
                    path=files[choices[1][0]].path.name,
                )
            choices = [choices[int(np.nanargmin(apart))]]
        if choices:
            pairs[row] = choices[0]
    if not pairs and len(files) == 1 and len(files[0].number) == len(names):
        return {row: (0, row) for row in range(len(names))}  # renamed; the checks decide
    _check_lenses(names, pairs, files)
    return pairs


def _check_lenses(
    names: Sequence[str], pairs: dict[int, tuple[int, int]], files: Sequence[Exposures]
) -> None:
    """Refuse two photos of one exposure, unless they are of several lenses (other letters at the end)."""
    seen: dict[tuple[int, int, str], str] = {}
    for row, (k, event) in pairs.items():
        lens = re.sub(r".*\d", "", Path(names[row]).stem)
        before = seen.setdefault((k, event, lens), names[row])
        if before != names[row]:
            raise InputError(
                f"{before} and {names[row]} both have the number of exposure {files[k].number[event]}: "
                f"{_REMEDY}",
                path=files[k].path.name,
            )


def _check_positions(
    photos: Telemetry,
    names: Sequence[str],
    files: Sequence[Exposures],
    pairs: dict[int, tuple[int, int]],
) -> None:
    """Check that photos are where their exposures are, and not where others are."""
    own_m: list[float] = []
    other_m: list[float] = []
    for row, (k, event) in pairs.items():
        apart_m = _apart_m(photos.lat_lon_deg[row], files[k].lat_lon_deg[event])
        if apart_m > _MAX_APART_M:
            raise InputError(
                f"{names[row]} is {apart_m:.0f} m from exposure {files[k].number[event]}: {_REMEDY}",
                path=files[k].path.name,
            )
        if math.isnan(apart_m):
            continue
        near = [e for e in (event - 1, event + 1) if 0 <= e < len(files[k].number)]
        others = [_apart_m(photos.lat_lon_deg[row], files[k].lat_lon_deg[e]) for e in near]
        own_m.append(apart_m)
        other_m.append(float(np.nanmin([apart_m, *others])))
    if own_m and np.median(own_m) > np.median(other_m) + _SHIFTED_M:
        row, (k, event) = next(iter(pairs.items()))
        raise InputError(
            f"most photos are nearer to another exposure than to that of their number "
            f"({names[row]}: {files[k].number[event]}): {_REMEDY}",
            path=files[k].path.name,
        )


def _check_times(
    photos: Telemetry,
    names: Sequence[str],
    files: Sequence[Exposures],
    pairs: dict[int, tuple[int, int]],
) -> None:
    """Check that photos and exposures of each file have the same intervals; zones may differ."""
    for k, exposures in enumerate(files):
        rows = np.array([row for row, (file, _) in pairs.items() if file == k], dtype=np.int64)
        events = [event for file, event in pairs.values() if file == k]
        late_s = photos.utc_s[rows] - exposures.time_s[events]
        known = np.isfinite(late_s)
        placed = np.isfinite(photos.lat_lon_deg[rows] + exposures.lat_lon_deg[events]).all(axis=1)
        if len(rows) and not placed.any() and known.sum() < 2:
            raise InputError(
                f"neither positions nor times in the photos confirm that {names[rows[0]]} is exposure "
                f"{exposures.number[events[0]]}: {_REMEDY}",
                path=exposures.path.name,
            )
        if known.any():
            off_s = np.abs(late_s - np.median(late_s[known]))
            worst = int(np.nanargmax(off_s))
            if off_s[worst] > _MAX_CLOCK_S:
                raise InputError(
                    f"{names[rows[worst]]} was taken {off_s[worst]:.0f} s from exposure "
                    f"{exposures.number[events[worst]]}, other than the other photos: {_REMEDY}",
                    path=exposures.path.name,
                )


def _apart_m(one: np.ndarray, other: np.ndarray) -> float:
    """Return the horizontal distance of two positions; NaN if one is unknown."""
    if np.isnan(one + other).any():
        return math.nan
    return float(np.hypot(*metres_from_first_fix(np.array([one, other]))[1]))
