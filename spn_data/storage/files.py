"""Files and folders that appear atomically under their name, lock files, and CSV files."""

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
    """Open a temporary file that replaces `path` when the block ends.

    An existing file remains until then; if the block fails, the temporary file is removed.

    Parameters
    ----------
    path : Path
        The file to write.
    mode : str
        "wb", or "w" for UTF-8 text with line ends as given.

    Raises
    ------
    StageError
        If the file cannot be written, e.g. because the disk is full.
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
    """Write text (UTF-8) or bytes with `atomic_writer`.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    with atomic_writer(path, "w" if isinstance(content, str) else "wb") as file:
        file.write(content)


def replace_folder(partial: Path, target: Path) -> None:
    """Rename a complete folder to its final name; an existing folder of that name is removed only then.

    Parameters
    ----------
    partial : Path
        The complete folder, on the same file system.
    target : Path
        Its final name.
    """
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    partial.rename(target)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def locked(folder: Path, program: str) -> Iterator[None]:
    """Hold the lock file of an existing folder, so that only one process at a time works in it.

    Parameters
    ----------
    folder : Path
        The folder; its file `LOCK` is locked.
    program : str
        Name of the program for the error message.

    Raises
    ------
    InUseError
        If another process holds the lock.
    StageError
        If the folder cannot be written to.
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
    """Write columns of cells as a CSV file with a header row, atomically.

    Parameters
    ----------
    path : Path
        The file to write.
    columns : mapping of str to iterable
        Cells of each column, all of one length.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_atomically(path, text.getvalue())


def read_csv(
    path: Path, columns: Collection[str], *, max_bytes: int = 500_000_000
) -> Iterator[tuple[int, dict[str, str]]]:
    """Read a CSV file written by `write_csv`, row by row.

    Parameters
    ----------
    path : Path
        The file to read.
    columns : collection of str
        The expected header.
    max_bytes : int, optional
        Largest file size accepted.

    Yields
    ------
    line : int
        Line number, counted from 1.
    cells : dict of str to str
        The row's cells by column.

    Raises
    ------
    InputError
        If the file cannot be read, is too large, or has another format; with the line if known.
    """
    try:
        if path.stat().st_size > max_bytes:
            raise InputError(f"is larger than {max_bytes // 1_000_000} MB", path=path)
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file, strict=True)
            try:
                if next(reader, None) != list(columns):
                    message = f"the header is not that of {path.name}: {','.join(columns)}"
                    raise InputError(message, path=path, line=1)
                for cells in reader:
                    if len(cells) != len(columns):
                        message = f"{len(cells)} cells, expected {len(columns)}"
                        raise InputError(message, path=path, line=reader.line_num)
                    yield reader.line_num, dict(zip(columns, cells, strict=True))
            except csv.Error as error:
                message = f"is not a CSV file: {error}"
                raise InputError(message, path=path, line=reader.line_num) from error
    except OSError as error:
        raise InputError(f"can't be read: {error.strerror}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", path=path) from error


def make_folder(path: Path) -> None:
    """Create a folder and its parents; raise StageError if that is impossible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StageError(f"{path} cannot be created: {error.strerror}") from error
