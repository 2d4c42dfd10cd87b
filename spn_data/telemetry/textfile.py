"""Bounded reading of text files that a user gave."""

from __future__ import annotations

import codecs
import csv
from collections.abc import Iterator
from pathlib import Path

from spn_data.errors import InputError

# A 60 Hz subtitle file takes 1 MB a minute: an hour of flight is far below this.
MAX_TEXT_BYTES = 200_000_000
# Four and a half hours at 60 Hz; a file of tiny records could otherwise fill the memory.
MAX_RECORDS = 1_000_000


def read_text(path: Path | str, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a file, with "\\n" line ends and no byte-order mark; InputError if it is no text.

    UTF-8, or UTF-16 with a byte-order mark. Bytes that are not UTF-8 become U+FFFD: they stand in
    free text or degree signs, and where one stands in a number the parser reports it.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise InputError("not a file", path=path)
        if size > max_bytes:
            raise InputError(
                f"has {size / 1e6:.0f} MB, more than the {max_bytes / 1e6:.0f} MB of any telemetry",
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
    """(line, cells) of each row of a CSV that is not empty, the header first; `what` it should hold.

    Commas, semicolons or tabs between cells, whichever the header has most of; with semicolons, a comma in
    a number is its decimal sign. Raises InputError for an empty file and for quotes that never end.
    """
    lines = text.split("\n")
    skip = 0
    # Spreadsheets write "sep=;" first, loggers lines of comments.
    while skip < len(lines) and (
        not lines[skip].strip() or lines[skip].lower().startswith(("sep=", "#"))
    ):
        skip += 1
    if skip == len(lines):
        raise InputError(f"the file is empty: no {what} in it", path=path)
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
        raise InputError(f"is no CSV: {error}", path=path, line=skip + reader.line_num) from error
