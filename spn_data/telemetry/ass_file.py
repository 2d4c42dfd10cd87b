"""Subtitle files in the format of SubStation Alpha (.ass), as Autel drones write them beside a video."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from spn_data.errors import InputError
from spn_data.telemetry.dji_srt import telemetry_from_records
from spn_data.telemetry.textfile import read_text
from spn_data.telemetry.track import Telemetry

_TIME = re.compile(r"(\d{1,3}):(\d{1,2}):(\d{1,2}(?:\.\d{1,6})?)")


def read_ass(path: Path | str) -> Telemetry:
    """Read telemetry from the dialogue lines; raise InputError naming file and line if it has none."""
    text = read_text(path)
    if not text.strip():
        raise InputError("the file is empty: it contains no telemetry", path=path)
    return telemetry_from_records(_records(text), source=str(path))


def _records(text: str) -> Iterator[tuple[int, float, str]]:
    """Yield (line, time_s or NaN, text) of each dialogue line."""
    start, fields = 1, 10  # layer, start, end, style, name, three margins, effect, text
    for number, line in enumerate(text.split("\n"), 1):
        key, _, rest = line.partition(":")
        if key.strip() == "Format":  # of the section that follows; that of the events comes last
            names = [name.strip() for name in rest.split(",")]
            if "Start" in names and names[-1] == "Text":
                start, fields = names.index("Start"), len(names)
        elif key.strip() == "Dialogue":
            cells = rest.split(",", fields - 1)
            times = _TIME.fullmatch(cells[start].strip()) if len(cells) == fields else None
            time_s = float("nan")
            if times:
                time_s = 3600 * int(times[1]) + 60 * int(times[2]) + float(times[3])
            yield number, time_s, cells[-1].replace("\\N", "\n").replace("\\n", "\n")
