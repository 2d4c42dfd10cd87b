"""Our own telemetry file: a JSON object of the properties of the track, then one CSV row per record."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from spn_data.errors import FormatError
from spn_data.geometry.geodesy import HeightReference
from spn_data.storage.files import write_atomically
from spn_data.storage.json_files import DAMAGE, parse_json
from spn_data.telemetry.track import Telemetry

_COLUMNS = (
    "time_s,lat_deg,lon_deg,rel_alt_m,abs_alt_m,sigma_e_m,sigma_n_m,sigma_u_m,"
    "heading_deg,pitch_deg,roll_deg,utc_s,zoom"
)
_MAX_BYTES = 2**30


def write_track(path: Path, telemetry: Telemetry) -> None:
    """Write a telemetry track.

    Parameters
    ----------
    path : Path
        Target file. Its first line has the properties of the track as JSON after `# `, followed by a CSV
        header and the records.
    telemetry : Telemetry
        The track.
    """
    properties = {
        "version": 1,
        "kind": telemetry.kind,
        "source": telemetry.source,
        "abs_reference": telemetry.abs_reference.value,
        "utc_is_local": telemetry.utc_is_local,
        "notes": list(telemetry.notes),
    }
    rows = np.column_stack(
        [
            telemetry.time_s,
            telemetry.lat_lon_deg,
            telemetry.rel_alt_m,
            telemetry.abs_alt_m,
            telemetry.sigma_m,
            telemetry.gimbal_deg,
            telemetry.utc_s,
            telemetry.zoom,
        ]
    )
    lines = [f"# {json.dumps(properties)}", _COLUMNS]
    lines += [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in rows]
    write_atomically(path, "\n".join(lines) + "\n")


def read_track(path: Path) -> Telemetry:
    """Read a telemetry track.

    Parameters
    ----------
    path : Path
        A file written by `write_track`.

    Returns
    -------
    Telemetry
        The track.

    Raises
    ------
    FormatError
        If the file is not as `write_track` writes it.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise FormatError(f"{path}: too large for a telemetry track")
        first, header, *lines = path.read_text(encoding="utf-8").splitlines()
        properties = parse_json(first.removeprefix("# "))
        if properties["version"] != 1 or header != _COLUMNS:
            raise FormatError(f"{path}: not a telemetry track of this version")
        rows = np.array(
            [[float(cell) if cell else np.nan for cell in line.split(",")] for line in lines]
        ).reshape(len(lines), len(_COLUMNS.split(",")))
        track = Telemetry.from_columns(
            rows[:, 0],
            lat_lon_deg=rows[:, 1:3],
            rel_alt_m=rows[:, 3],
            abs_alt_m=rows[:, 4],
            sigma_m=rows[:, 5:8],
            gimbal_deg=rows[:, 8:11],
            utc_s=rows[:, 11],
            zoom=rows[:, 12],
        )
        return replace(
            track,
            kind=properties["kind"],
            source=properties["source"],
            abs_reference=HeightReference(properties["abs_reference"]),
            utc_is_local=properties["utc_is_local"],
            notes=tuple(properties["notes"]),
        )
    except (*DAMAGE, OSError) as error:
        raise FormatError(f"{path}: not a telemetry track ({error})") from error
