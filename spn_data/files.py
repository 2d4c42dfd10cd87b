"""Files that stand under their name only when they are complete."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from spn_data.errors import StageError


@contextmanager
def writing_whole(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """A file to write ("wb", or "w" for UTF-8 with its line ends as they are) that then takes its name.

    What stood there before stays until then, and of a failure nothing is left. Raises StageError where the
    disk does not take it.
    """
    temporary = path.with_name(f".{path.name}.part")
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    try:
        with temporary.open(mode, encoding=encoding, newline=newline) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        if temporary.exists():
            temporary.unlink()
        if isinstance(error, OSError):
            raise StageError(f"{path} cannot be written: {error.strerror}") from error
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """See `writing_whole`."""
    with writing_whole(path, "w" if isinstance(content, str) else "wb") as file:
        file.write(content)


def write_csv(path: Path, columns: Mapping[str, Iterable[object]]) -> None:
    """Columns of cells, all of one length, under their names; see `writing_whole`."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_whole(path, text.getvalue())
