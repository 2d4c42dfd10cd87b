"""CSV tables that state the position of each photo by its file name, such as corrected geotags."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import metres_from_first_fix
from spn_data.media.photo_file import PHOTO_SUFFIXES
from spn_data.telemetry.csv_columns import parse_header
from spn_data.telemetry.csv_log import log_of_rows
from spn_data.telemetry.textfile import MAX_RECORDS, csv_rows, read_text
from spn_data.telemetry.track import Telemetry

# Names of the column with the file, without case, blanks and underscores; the first that is there counts.
_FILE_COLUMNS = (
    *("sourcefile", "filename", "imagename", "photoname", "imagefile"),
    *("image", "photo", "file", "label", "name"),
)
_SUFFIXES = (".csv", ".tsv", ".txt")
_FAR_M = 100.0  # median distance of a table from the photos' own fixes that shows another flight


def with_photo_table(own: Telemetry, photos: Sequence[Path], path: Path) -> Telemetry | None:
    """Give photos the positions of a table with their file names.

    Parameters
    ----------
    own : Telemetry
        One record per photo, from their own metadata.
    photos : sequence of Path, length N
    path : Path
        A telemetry file.

    Returns
    -------
    Telemetry or None
        The same photos with the positions, heights and angles of the table; those that it does not name
        have no position. None if the file has no column of names of photos.

    Raises
    ------
    InputError
        If the table is damaged, two rows are of one photo, no row is of a photo, or the positions are far
        from those that the photos state.
    """
    if path.suffix.lower() not in _SUFFIXES:
        return None
    rows = csv_rows(read_text(path), path, "telemetry")
    header_line, header = next(rows, (1, []))
    names = [re.sub(r"[\s_]+", "", cell).lower() for cell in header]
    column = next((names.index(name) for name in _FILE_COLUMNS if name in names), None)
    if column is None:
        return None
    body: list[tuple[int, list[str]]] = []
    for line, row in rows:
        if len(body) == MAX_RECORDS:
            raise InputError(f"has more than {MAX_RECORDS:,} rows", path=path, line=line)
        body.append((line, row))
    matched = _rows_of_photos(photos, body, column, path)
    if not matched:
        if not any(_is_photo(cells[column]) for _, cells in body if column < len(cells)):
            return None  # names of something else, such as waypoints
        raise InputError(
            f"its column {header[column]} names none of the {len(photos)} photos ({photos[0].name}); "
            "correct the names, or move the file away",
            path=path,
        )
    # The number of the photo takes the place of times, which other columns may state too.
    timeless = ["" if {"time", "utc"} & parse_header([cell]).keys() else cell for cell in header]
    numbered = [
        (body[row][0], [str(photo), *body[row][1]]) for photo, row in sorted(matched.items())
    ]
    table = log_of_rows(numbered, ["time_s", *timeless], header_line, path)
    return _merged(own, table, len(photos), path)


def _rows_of_photos(
    photos: Sequence[Path], body: list[tuple[int, list[str]]], column: int, path: Path
) -> dict[int, int]:
    """Return the row of each photo: the one whose path has the longest ending in common, if only one has."""
    ends: dict[str, list[tuple[int, tuple[str, ...]]]] = {}
    for row, (_, cells) in enumerate(body):
        cell = cells[column] if column < len(cells) else ""
        parts = PurePosixPath(cell.strip().replace("\\", "/").lower()).parts
        if parts:
            ends.setdefault(parts[-1], []).append((row, parts))
    matched: dict[int, int] = {}
    for k, photo in enumerate(photos):
        own = tuple(part.lower() for part in photo.resolve().parts)
        found = [(_common(own, parts), row) for row, parts in ends.get(photo.name.lower(), ())]
        if not found:
            continue
        longest = max(found)[0]
        rows = [row for length, row in found if length == longest]
        if len(rows) > 1:
            raise InputError(
                f"the lines {body[rows[0]][0]} and {body[rows[1]][0]} are both of {photo.name}",
                path=path,
                line=body[rows[1]][0],
            )
        matched[k] = rows[0]
    return matched


def _is_photo(cell: str) -> bool:
    return PurePosixPath(cell.strip().replace("\\", "/").lower()).suffix in PHOTO_SUFFIXES


def _common(one: tuple[str, ...], other: tuple[str, ...]) -> int:
    """Return the number of equal parts at the end of two paths."""
    pairs = list(zip(reversed(one), reversed(other), strict=False))
    return next((k for k, (a, b) in enumerate(pairs) if a != b), len(pairs))


def _merged(own: Telemetry, table: Telemetry, count: int, path: Path) -> Telemetry:
    """Return the photos with the values of a table whose times are numbers of photos."""
    rows = np.rint(table.time_s).astype(np.int64)
    lat_lon = np.full((count, 2), np.nan)
    lat_lon[rows] = table.lat_lon_deg
    _check_near(own, lat_lon, path)

    def of_table(values: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """Return a column of the table; the photos' own if the table does not state it."""
        if not np.isfinite(values).any():
            return otherwise
        column = np.full(otherwise.shape, np.nan)
        column[rows] = values
        return column

    stated = int(np.isfinite(lat_lon).all(axis=1).sum())
    note = f"positions of {stated} of {count} photos are from {path.name}, by their file names"
    if stated < count:
        note += "; the others have none"
    nothing = np.full(count, np.nan)
    return replace(
        own,
        lat_lon_deg=lat_lon,
        rel_alt_m=of_table(table.rel_alt_m, own.rel_alt_m),
        abs_alt_m=of_table(table.abs_alt_m, nothing),
        abs_reference=table.abs_reference,
        sigma_m=of_table(table.sigma_m, np.full((count, 3), np.nan)),
        gimbal_deg=of_table(table.gimbal_deg, own.gimbal_deg),
        notes=(*own.notes, *table.notes, note),
    )


def _check_near(own: Telemetry, lat_lon: np.ndarray, path: Path) -> None:
    """Raise InputError if the table is far from the positions that the photos state."""
    both = own.has_fix & np.isfinite(lat_lon).all(axis=1)
    if not both.any():
        return
    pairs = np.concatenate([own.lat_lon_deg[both], lat_lon[both]])
    metres = metres_from_first_fix(pairs)
    apart_m = np.linalg.norm(metres[: both.sum()] - metres[both.sum() :], axis=1)
    if np.median(apart_m) > _FAR_M:
        raise InputError(
            f"its positions are {np.median(apart_m):.0f} m from those that the photos state (median): it is "
            "of another flight, or its columns are mixed up",
            path=path,
        )
