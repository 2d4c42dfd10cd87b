"""Activities in Garmin's FIT (.fit), read by fitdecode."""

from __future__ import annotations

import math
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.media.extras import import_extra
from spn_data.telemetry.accuracy import FIX_3D, sigma_from_fix
from spn_data.telemetry.flight_log import LoggedFixes, check_count, check_size, log_track
from spn_data.telemetry.track import Telemetry

_MAX_BYTES = 100_000_000  # a day of records each second has some megabytes
_FIT_EPOCH_S = 631_065_600.0  # 31 December 1989, in seconds since 1970
_FIRST_DATE = 0x10000000  # smaller times count from the start of the device
_DEGREES = 180 / 2**31  # of one semicircle
_NAN = math.nan
# Messages with positions, the more frequent one counts; and their field of milliseconds, if they have one.
_RECORD, _GPS = 20, 160
_FIELDS = ("timestamp", "position_lat", "position_long")

_Row = tuple[float, float, float, float, float, float]


def read_fit(path: Path) -> Telemetry:
    """Read the positions of a FIT file; raise InputError if it has none or fitdecode is missing.

    The reference of FIT's altitude is not defined, hence unknown; `gps_accuracy` is the standard deviation of
    each horizontal axis. Records before damage are used.
    """
    check_size(path, _MAX_BYTES)
    fitdecode = import_extra("fitdecode", "fit", "Garmin's FIT", path)
    rows: dict[int, list[_Row]] = {_RECORD: [], _GPS: []}
    starts_s: list[float] = []
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            _collect(fitdecode, path, rows, starts_s)
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", path=path) from error
        except (
            *(fitdecode.FitError, ArithmeticError, AssertionError, AttributeError, LookupError),
            *(TypeError, ValueError, struct.error),
        ) as error:
            words = str(error).replace("\n", " ")[:150] or type(error).__name__
            if not any(rows.values()):
                raise InputError(
                    f"is not a FIT file that can be read: {words}", path=path
                ) from error
            notes.append(f"it is damaged ({words}): only the records before are used")
    if caught and not notes:
        notes.append(f"it is damaged ({str(caught[0].message)[:150]}): its values may be wrong")
    counts = {number: sum(math.isfinite(row[1]) for row in found) for number, found in rows.items()}
    best = max(counts, key=lambda number: counts[number])
    if not counts[best]:
        raise InputError(
            "contains no positions: no record states latitude and longitude", path=path
        )
    table = np.array(rows[best], dtype=np.float64)
    if len(starts_s):
        first_s = starts_s[0] - float(np.nanmin(table[:, 0]))
        notes.append(
            f"video recordings by the device: {len(starts_s)}, the first {first_s:.1f} s after the first "
            "record"
        )
    return log_track(path, "fit", _fixes(table), notes=tuple(notes))


def _collect(
    fitdecode: Any, path: Path, rows: dict[int, list[_Row]], starts_s: list[float]
) -> None:
    """Collect time, position, altitude, accuracy and UTC of each record, and the starts of videos."""
    with fitdecode.FitReader(path) as reader:
        for frame in reader:
            if frame.frame_type != fitdecode.FIT_FRAME_DATA:
                continue
            number = frame.global_mesg_num
            if number == 161 and frame.get_value("camera_event_type", fallback="") == "video_start":
                starts_s.append(_time(frame))
            if number not in rows:
                continue
            lat, lon = (_number(frame, name) * _DEGREES for name in _FIELDS[1:])
            height_m = _number(frame, "enhanced_altitude")
            height_m = _number(frame, "altitude") if math.isnan(height_m) else height_m
            utc_s = (
                _number(frame, "utc_timestamp") if number == _GPS else _number(frame, "timestamp")
            )
            utc_s = _FIT_EPOCH_S + utc_s if utc_s >= _FIRST_DATE else _NAN
            time_s = _time(frame)
            utc_s += time_s % 1.0
            rows[number].append((time_s, lat, lon, height_m, _number(frame, "gps_accuracy"), utc_s))
            check_count(len(rows[number]), path)


def _time(frame: Any) -> float:
    """Return seconds on the device's clock."""
    milliseconds = _number(frame, "timestamp_ms")
    return _number(frame, "timestamp") + (0.0 if math.isnan(milliseconds) else milliseconds * 1e-3)


def _number(frame: Any, name: str) -> float:
    """Return the number of a field without conversion of dates; NaN if it is not stated."""
    is_raw = "timestamp" in name
    value = frame.get_value(name, fallback=None, raw_value=is_raw)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return _NAN
    return float(value) if math.isfinite(value) else _NAN


def _fixes(table: np.ndarray) -> LoggedFixes:
    """Return fixes of rows (N, 6) of time, latitude, longitude, altitude, accuracy and UTC."""
    lat_lon = table[:, 1:3].copy()
    sigma_m = [sigma_from_fix(FIX_3D, horizontal_m=accuracy) for accuracy in table[:, 4].tolist()]
    return LoggedFixes(
        table[:, 0],
        table[:, 5],
        lat_lon,
        table[:, 3],
        np.array(sigma_m, dtype=np.float64),
        HeightReference.UNKNOWN,
    )
