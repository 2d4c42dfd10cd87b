"""Size-limited reading of text files supplied by the user."""

from __future__ import annotations

import codecs
import csv
import math
from collections.abc import Iterator
from pathlib import Path

from spn_data.errors import InputError

# A 60 Hz subtitle file takes 1 MB per minute, so an hour of flight is far below this limit.
MAX_TEXT_BYTES = 200_000_000
# Four and a half hours at 60 Hz; a file of tiny records could otherwise exhaust memory.
MAX_RECORDS = 1_000_000


def read_text(path: Path | str, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    r"""Read a text file with "\n" line ends and without a byte-order mark.

    The file is UTF-8, or UTF-16 with a byte-order mark. Bytes that are not UTF-8 become U+FFFD: they occur in
    free text or degree signs, and the parser reports them inside a number.

    Parameters
    ----------
    path : Path or str
        The file.
    max_bytes : int
        Largest size accepted.

    Returns
    -------
    str
        Its text.

    Raises
    ------
    InputError
        If the file cannot be read, is too large or is binary.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise InputError("not a file", path=path)
        if size > max_bytes:
            raise InputError(
                f"has {size / 1e6:.0f} MB; files of up to {max_bytes / 1e6:.0f} MB are supported",
                path=path,
            )
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = data.decode("utf-16", errors="replace")
    else:
        if b"\0" in data:
            raise InputError("is binary, not text", path=path)
        text = data.decode("utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def csv_rows(text: str, path: Path | str, what: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the non-empty rows of a CSV text, header first.

    Parameters
    ----------
    text : str
        The text. Cells are separated by commas, semicolons or tabs, whichever is most frequent in the header;
        with semicolons, a comma in a number is the decimal separator.
    path : Path or str
        Names the file in messages.
    what : str
        What the file should contain, for messages.

    Yields
    ------
    line : int
        Line number.
    cells : list of str
        Stripped cells of the row.

    Raises
    ------
    InputError
        If the file is empty or a quote is never closed.
    """
    lines = text.split("\n")
    skip = 0
    # Spreadsheets start with "sep=;", loggers with comment lines.
    while skip < len(lines) and (
        not lines[skip].strip() or lines[skip].lower().startswith(("sep=", "#"))
    ):
        skip += 1
    if skip == len(lines):
        raise InputError(f"the file is empty: it contains no {what}", path=path)
    delimiter = max(",;\t", key=lines[skip].count)
    reader = csv.reader(lines[skip:], delimiter=delimiter)
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if delimiter == ";":
                cells = [cell.replace(",", ".") for cell in cells]
            if any(cells):
                yield skip + reader.line_num, cells
    except csv.Error as error:
        raise InputError(
            f"is not valid CSV: {error}", path=path, line=skip + reader.line_num
        ) from error


def finite_number(text: str, name: str) -> float:
    """Parse a finite number; the ValueError names the field."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is {text[:40]!r}, not a number")
    return value
