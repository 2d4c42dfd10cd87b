"""NMEA 0183 sentences of GNSS receivers (.nmea), parsed by pynmea2."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.media.extras import import_extra
from spn_data.telemetry.accuracy import (
    FIX_3D,
    FIX_DGNSS,
    FIX_RTK,
    FIX_RTK_FLOAT,
    NAN_SIGMA,
    NO_FIX,
    Sigma,
    sigma_from_fix,
)
from spn_data.telemetry.flight_log import (
    LoggedFixes,
    absolute_heights,
    check_count,
    check_size,
    log_track,
)
from spn_data.telemetry.track import Telemetry

_MAX_BYTES = 500_000_000
_MAX_LINE = 400  # NMEA allows 82
_NEEDED = ("GGA", "RMC", "GST", "ZDA")
# Quality in GGA: 3 is military GPS; 6 to 8 (estimated, typed in, simulated) are not measured.
_QUALITY = {1: FIX_3D, 2: FIX_DGNSS, 3: FIX_3D, 4: FIX_RTK, 5: FIX_RTK_FLOAT}
_NAN = math.nan
_HALF_DAY_S, _DAY_S = 43_200.0, 86_400.0


@dataclass(slots=True)
class _Epoch:
    """What the sentences of one time of day state."""

    second: float  # of the day
    day: date | None = None
    lat_lon: tuple[float, float] = (_NAN, _NAN)
    from_gga: bool = False
    fix: int = NO_FIX
    amsl_m: float = _NAN
    geoid_m: float = _NAN
    hdop: float = _NAN
    sigma_m: Sigma = NAN_SIGMA


@dataclass
class _Log:
    """Epochs of a file, and what is wrong with its sentences."""

    epochs: list[_Epoch] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    bad_count: int = 0
    unmeasured: int = 0

    def epoch(self, second: float) -> _Epoch:
        """Return the epoch of a time of day, a new one if it differs from the last."""
        if not self.epochs or self.epochs[-1].second != second:
            self.epochs.append(_Epoch(second))
        return self.epochs[-1]

    def complain(self, line: int, what: str) -> None:
        """Count a sentence that cannot be used."""
        self.bad_count += 1
        if not self.bad:
            self.bad.append(f"line {line}: {what}")


def is_nmea(start: str) -> bool:
    """Return whether a file with this beginning has NMEA sentences of a GNSS receiver."""
    lines = start.lstrip("\ufeff").splitlines()[:20]
    return any(
        line[:1] == "$" and line[3:6] in ("GGA", "RMC", "GSV", "GSA", "GLL") for line in lines
    )


def read_nmea(path: Path) -> Telemetry:
    """Read the positions of an NMEA log; raise InputError if it has none or pynmea2 is missing.

    Sentences with a wrong checksum are left out and counted. GST states standard deviations, otherwise they
    follow from the quality and dilution in GGA. Heights are above the ellipsoid if GGA states the height of
    the geoid, otherwise above sea level.
    """
    check_size(path, _MAX_BYTES)
    pynmea2 = import_extra("pynmea2", "nmea", "NMEA sentences", path)
    log = _Log()
    try:
        for line, sentence in _sentences(path):
            _add(log, pynmea2, line, sentence)
            check_count(len(log.epochs), path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    positions = [epoch for epoch in log.epochs if epoch.from_gga or epoch.fix != NO_FIX]
    if not positions:
        why = f"; sentences that cannot be used: {log.bad_count}, {log.bad[0]}" if log.bad else ""
        raise InputError(
            f"contains no positions: it has no usable GGA or RMC sentence{why}", path=path
        )
    notes = []
    if log.bad_count:
        notes.append(f"sentences left out: {log.bad_count}, the first at {log.bad[0]}")
    if log.unmeasured:
        notes.append(
            f"positions left out because they are estimated or simulated, not measured: {log.unmeasured}"
        )
    if positions and any(epoch.from_gga for epoch in positions):
        positions = [epoch for epoch in positions if epoch.from_gga]
    else:
        notes.append("it has no GGA sentences, and so no heights and no accuracies")
    time_s, dated = _times(log.epochs)
    times = {id(epoch): second for epoch, second in zip(log.epochs, time_s.tolist(), strict=True)}
    chosen_s = np.array([times[id(epoch)] for epoch in positions])
    fixes, height_notes = _fixes(positions, chosen_s, dated)
    return log_track(path, "nmea", fixes, notes=(*notes, *height_notes))


def _sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each sentence needed, without what precedes it in its line."""
    with path.open("rb") as file:
        number = 0
        while raw := file.readline(100_000):
            number += 1
            at = raw.rfind(b"$")
            text = raw[at : at + _MAX_LINE].decode("ascii", "replace").strip() if at >= 0 else ""
            if text[3:6] in _NEEDED:
                yield number, text


def _add(log: _Log, pynmea2: Any, line: int, text: str) -> None:
    """Add what a sentence states to its epoch."""
    try:
        sentence = pynmea2.parse(text)
        time: Any = getattr(sentence, "timestamp", None)
        if not hasattr(time, "hour"):
            return  # before its first fix, a receiver does not know the time
        second = 3600.0 * time.hour + 60 * time.minute + time.second + time.microsecond * 1e-6
        kind = text[3:6]
        epoch = log.epoch(second)
        if kind == "GGA":
            _add_gga(log, epoch, sentence)
        elif kind == "GST":
            values = [
                _number(getattr(sentence, f"std_dev_{name}"))
                for name in ("longitude", "latitude", "altitude")
            ]
            epoch.sigma_m = (values[0], values[1], values[2])
        elif kind == "ZDA":
            epoch.day = sentence.datestamp
        elif sentence.status == "A" and getattr(sentence, "mode_indicator", "A") not in (
            "N",
            "E",
            "M",
            "S",
        ):
            if hasattr(sentence.datestamp, "year"):
                epoch.day = sentence.datestamp
            if not epoch.from_gga:
                epoch.lat_lon, epoch.fix = _lat_lon(sentence), FIX_3D
    except (AttributeError, TypeError, ValueError, IndexError) as error:
        reason = error.args[0] if error.args else "damaged"
        reason = reason[0] if isinstance(reason, tuple) else reason
        log.complain(line, f"{str(reason)[:80]}")


def _add_gga(log: _Log, epoch: _Epoch, sentence: Any) -> None:
    quality = sentence.gps_qual if isinstance(sentence.gps_qual, int) else 0
    epoch.from_gga = True
    log.unmeasured += quality > 5
    epoch.fix = _QUALITY.get(quality, NO_FIX)
    epoch.lat_lon = _lat_lon(sentence) if epoch.fix != NO_FIX else (_NAN, _NAN)
    epoch.amsl_m, epoch.geoid_m = _number(sentence.altitude), _number(sentence.geo_sep)
    epoch.hdop = _number(sentence.horizontal_dil)


def _lat_lon(sentence: Any) -> tuple[float, float]:
    """Return degrees; raise ValueError if a letter is missing."""
    if sentence.lat_dir not in ("N", "S") or sentence.lon_dir not in ("E", "W"):
        raise ValueError("the position has no letters N or S, E or W")
    return float(sentence.latitude), float(sentence.longitude)


def _number(value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return _NAN
    return number if math.isfinite(number) else _NAN


def _times(epochs: list[_Epoch]) -> tuple[np.ndarray, bool]:
    """Return seconds since 1970 of the epochs, or of a day that is not stated, and whether it is stated.

    Epochs without a date follow the one before, on the next day if the time of day starts over; those before
    the first date precede it.
    """
    days: list[float] = []
    day, dated = 0.0, False
    last_s = epochs[0].second
    for epoch in epochs:
        if epoch.second < last_s - _HALF_DAY_S:
            day += 1
        last_s = epoch.second
        if epoch.day is not None:
            stated = float((epoch.day - date(1970, 1, 1)).days)
            if not dated:
                days = [earlier + stated - day for earlier in days]
            day, dated = stated, True
        days.append(day)
    seconds = np.array([epoch.second for epoch in epochs])
    return np.array(days) * _DAY_S + seconds, dated


def _fixes(epochs: list[_Epoch], time_s: np.ndarray, dated: bool) -> tuple[LoggedFixes, list[str]]:
    lat_lon = np.array([epoch.lat_lon for epoch in epochs])
    known = np.isfinite(lat_lon).all(axis=1)
    amsl_m = np.where(known, [epoch.amsl_m for epoch in epochs], np.nan)
    geoid_m = np.array([epoch.geoid_m for epoch in epochs])
    ellipsoid_m = amsl_m + geoid_m
    if not np.nan_to_num(geoid_m[known]).any():
        ellipsoid_m = np.full(len(epochs), np.nan)  # 0.0 throughout: the receiver has no geoid
    height_m, reference, notes = absolute_heights(amsl_m, ellipsoid_m)
    sigma_m = [
        epoch.sigma_m
        if all(value > 0 for value in epoch.sigma_m)
        else sigma_from_fix(epoch.fix, hdop=epoch.hdop)
        for epoch in epochs
    ]
    utc_s = time_s if dated else np.full(len(epochs), np.nan)
    return LoggedFixes(time_s, utc_s, lat_lon, height_m, np.array(sigma_m), reference), notes
