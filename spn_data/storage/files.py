"""Files and folders that stand under their name only when complete; locks; CSV read as it is written."""

from __future__ import annotations

import csv
import fcntl
import io
import os
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from spn_data.errors import InputError, InUseError, StageError

LOCK = ".lock"


@contextmanager
def atomic_writer(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
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


def write_atomically(path: Path, content: str | bytes) -> None:
    """See `atomic_writer`."""
    with atomic_writer(path, "w" if isinstance(content, str) else "wb") as file:
        file.write(content)


def replace_folder(partial: Path, target: Path) -> None:
    """Give a complete folder its name; what stood there, if anything, goes only then."""
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    partial.rename(target)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def locked(folder: Path, program: str) -> Iterator[None]:
    """Only one process at a time works in a folder, which exists: its file LOCK is held.

    Raises InUseError, which names the program, where another does, StageError where nothing can be written.
    """
    try:
        handle = (folder / LOCK).open("w")
    except OSError as error:
        raise StageError(f"{folder} cannot be written to: {error.strerror}") from error
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InUseError(f"{folder} is in use by another {program}") from error
        yield


def write_csv(path: Path, columns: Mapping[str, Iterable[object]]) -> None:
    """Columns of cells, all of one length, under their names; see `atomic_writer`."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_atomically(path, text.getvalue())


def read_csv(
    path: Path, columns: Collection[str], *, max_bytes: int = 500_000_000
) -> Iterator[tuple[int, dict[str, str]]]:
    """(line, cells by column) of each row that `write_csv` wrote with these columns.

    Raises InputError, with the line, where it is another file, and beyond `max_bytes`.
    """
    try:
        if path.stat().st_size > max_bytes:
            raise InputError(f"is larger than {max_bytes // 1_000_000} MB", path=path)
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file, strict=True)
            try:
                if next(reader, None) != list(columns):
                    told = f"the header is not that of {path.name}: {','.join(columns)}"
                    raise InputError(told, path=path, line=1)
                for cells in reader:
                    if len(cells) != len(columns):
                        told = f"{len(cells)} cells, expected {len(columns)}"
                        raise InputError(told, path=path, line=reader.line_num)
                    yield reader.line_num, dict(zip(columns, cells, strict=True))
            except csv.Error as error:
                told = f"is not a CSV file: {error}"
                raise InputError(told, path=path, line=reader.line_num) from error
    except OSError as error:
        raise InputError(f"can't be read: {error.strerror}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", path=path) from error
