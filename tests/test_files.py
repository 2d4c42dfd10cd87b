"""Files that stand under their name only when they are complete."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from spn_data.errors import StageError
from spn_data.files import write_csv, write_whole, writing_whole


def test_a_failure_leaves_what_stood_there_and_nothing_else(tmp_path: Path) -> None:
    """Neither the caller's mistake nor a disk that is full touches the file or leaves a rest."""
    path = tmp_path / "list.csv"
    write_whole(path, "before")
    with pytest.raises(TypeError):
        write_whole(path, 3)  # type: ignore[arg-type]
    with (
        pytest.raises(StageError, match=r"list\.csv cannot be written: No space left"),
        writing_whole(path, "w"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_text_is_utf8_with_its_own_line_ends(tmp_path: Path) -> None:
    """Whatever the locale, so that it is read on another machine."""
    write_csv(tmp_path / "a.csv", {"straße": ["é", "x\r\ny"], "n": [1, 2]})
    assert (tmp_path / "a.csv").read_bytes() == 'straße,n\né,1\n"x\r\ny",2\n'.encode()


def test_a_place_that_takes_no_file_is_told_in_one_line(tmp_path: Path) -> None:
    """A folder that is missing is the user's to see, with the file's name."""
    with pytest.raises(StageError, match=r"none/a\.txt cannot be written: No such file"):
        write_whole(tmp_path / "none" / "a.txt", "")
