"""Atomic writing of files, and CSV files."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from spn_data.errors import InputError, StageError
from spn_data.storage.files import atomic_writer, read_csv, write_atomically, write_csv


def test_a_failure_leaves_what_stood_there_and_nothing_else(tmp_path: Path) -> None:
    """Neither an exception in the block nor a full disk changes the file or leaves a temporary one."""
    path = tmp_path / "list.csv"
    write_atomically(path, "before")
    with pytest.raises(TypeError):
        write_atomically(path, 3)  # type: ignore[arg-type]
    with (
        pytest.raises(StageError, match=r"list\.csv cannot be written: No space left"),
        atomic_writer(path, "w"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_text_is_utf8_with_its_own_line_ends(tmp_path: Path) -> None:
    """Text is UTF-8 with fixed line ends whatever the locale, so other machines can read it."""
    write_csv(tmp_path / "a.csv", {"straße": ["é", "x\r\ny"], "n": [1, 2]})
    assert (tmp_path / "a.csv").read_bytes() == 'straße,n\né,1\n"x\r\ny",2\n'.encode()


def test_a_place_that_takes_no_file_is_told_in_one_line(tmp_path: Path) -> None:
    """A missing folder is reported in one line with the name of the file."""
    with pytest.raises(StageError, match=r"none/a\.txt cannot be written: No such file"):
        write_atomically(tmp_path / "none" / "a.txt", "")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,c\n1,2\n", r"t\.csv:1: the header is not that of t\.csv: a,b"),
        (b"", r"t\.csv:1: the header is not"),
        (b"a,b\n1,2\n3\n", r"t\.csv:3: 1 cells, expected 2"),
        (b'a,b\n1,"2\n', r"t\.csv:2: is not a CSV file: unexpected end"),
        (b"a,b\n1,\xff\n", r"t\.csv: is not UTF-8 text"),
        (b"a,b\n" + b"1,2\n" * 99, r"t\.csv: is larger than 0 MB"),
    ],
)
def test_csv_of_others_is_refused_with_its_line(
    tmp_path: Path, content: bytes, message: str
) -> None:
    """Other headers, truncated rows, unclosed quotes, invalid UTF-8 and oversized files are refused."""
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        list(read_csv(path, ["a", "b"], max_bytes=300))
