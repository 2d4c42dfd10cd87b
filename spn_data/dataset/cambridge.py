"""Pose lists in Cambridge Landmarks format (Kendall et al. 2015), such as dataset_train.txt.

Three header lines are followed by one line `path x y z qw qx qy qz` per image: the camera centre in the
world, and the quaternion that rotates world axes into camera axes, scalar first.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.dataset.nvm import has_image_suffix
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats
from spn_data.storage.files import write_atomically

TRAIN_LIST, VALIDATION_LIST, TEST_LIST = (
    f"dataset_{part}.txt" for part in ("train", "validation", "test")
)
NVM = "reconstruction.nvm"  # the model next to the lists
HEADER = ("Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", "")
MAX_FRAMES = 1_000_000
_MAX_LINE_BYTES = 4096
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d{1,3})?")
# Printed with six decimals, a unit quaternion has a length within 1e-6 of one.
_UNIT_TO_THE_DIGITS = 1e-5
_UNIT_AT_ALL = 0.01
_FAR_TIMES = 20.0


@dataclass(frozen=True, eq=False)
class CambridgeList:
    """Images and their poses, in the order of the file.

    Names may contain spaces, if they end as names of images.

    Attributes
    ----------
    names : tuple of str
        N unique image paths below the scene's folder, with "/" between folders.
    poses : Poses
        N poses in the world of the file, which does not state unit, origin or direction of up. Quaternions
        that are unit to the file's precision are kept as printed, so that they can be printed identically.
    quats_as_read : ndarray, shape (N, 4)
        Quaternions as printed in the file, scalar first.
    header : tuple of str
        First three lines of the file.
    """

    names: tuple[str, ...]
    poses: Poses
    quats_as_read: np.ndarray
    header: tuple[str, str, str] = HEADER

    def __len__(self) -> int:
        return len(self.names)

    def select(self, index: np.ndarray) -> CambridgeList:
        """Return some of the images, by their rows."""
        names = tuple(self.names[k] for k in index)
        return CambridgeList(names, self.poses[index], self.quats_as_read[index], self.header)


def read_cambridge(path: Path | str) -> CambridgeList:
    """Read a pose list in Cambridge Landmarks format.

    Parameters
    ----------
    path : path-like
        List file.

    Returns
    -------
    CambridgeList
        Images and poses.

    Raises
    ------
    InputError
        With the line number, if the file is malformed or an image path leads out of its folder.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError("is not a file" if path.exists() else "does not exist", path=path)
        lines = _lines(path)
        header = tuple(_header_line(path, k, next(lines, (k + 1, None))[1]) for k in range(3))
        rows = _rows(path, lines)
    except OSError as error:
        raise InputError(f"can't be read: {error.strerror}", path=path) from error
    values = np.array(list(rows.values()), dtype=np.float64).reshape(-1, 7)
    as_read = values[:, 3:]
    canonical = canonical_quats(as_read)
    # Normalising quaternions that are already unit would change the last digit of some.
    is_unit = np.abs(np.linalg.norm(as_read, axis=1) - 1) <= _UNIT_TO_THE_DIGITS
    sign = np.where(np.einsum("ni,ni->n", canonical, as_read) < 0, -1.0, 1.0)
    quats = np.where(is_unit[:, None], sign[:, None] * as_read, canonical)
    return CambridgeList(
        tuple(rows), Poses(values[:, :3], quats), as_read, (header[0], header[1], header[2])
    )


def write_cambridge(path: Path, names: Sequence[str], poses: Poses) -> None:
    """Write a pose list with six decimals, atomically.

    Parameters
    ----------
    path : Path
        File to write.
    names : sequence of str
        N image paths that `read_cambridge` accepts, without spaces.
    poses : Poses
        N poses.

    Raises
    ------
    ValueError
        If a name is invalid or not unique, or a pose is not finite.
    """
    if len(names) != len(poses) or len(set(names)) != len(names):
        raise ValueError(
            f"{len(names)} names ({len(set(names))} unique) do not match {len(poses)} poses"
        )
    numbers = np.concatenate([poses.centers, poses.quats_wxyz], axis=1)
    if not np.isfinite(numbers).all():
        raise ValueError("cannot write a pose that is not finite")
    lines = list(HEADER)
    for name, row in zip(names, numbers.tolist(), strict=True):
        _check_name(name)
        lines.append(" ".join([name, *(f"{value:.6f}" for value in row)]))
    write_atomically(path, "\n".join(lines) + "\n")


def position_outliers(centers: np.ndarray) -> np.ndarray:
    """Detect camera centres absurdly far from the others.

    Parameters
    ----------
    centers : ndarray, shape (N, 3)
        Camera centres.

    Returns
    -------
    ndarray of bool, shape (N,)
        Centres more than 20 times as far from the median centre as the 90 % quantile. All false for fewer
        than 10 centres.
    """
    if len(centers) < 10:
        return np.zeros(len(centers), dtype=bool)
    distance = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    usual = np.quantile(distance, 0.9)
    return distance > _FAR_TIMES * usual if usual > 0 else np.zeros(len(centers), dtype=bool)


def find_anomalies(listed: CambridgeList) -> list[str]:
    """Return a sentence for the user on each anomaly of a list; empty for an ordinary list.

    Anomalies are position outliers, quaternions that are not unit or have a negative scalar part, and
    duplicate poses.
    """
    sentences = []
    far = position_outliers(listed.poses.centers)
    middle = np.median(listed.poses.centers, axis=0) if len(listed) else np.zeros(3)
    for k in np.flatnonzero(far)[:10]:
        center = listed.poses.centers[k]
        position = ", ".join(f"{value:.6g}" for value in center)
        away = np.linalg.norm(center - middle)
        usual = np.quantile(np.linalg.norm(listed.poses.centers[~far] - middle, axis=1), 0.9)
        sentences.append(
            f"{listed.names[k]}: position ({position}) is {away:.3g} from the median position; "
            f"90 % of the others are within {usual:.3g}"
        )
    if np.count_nonzero(far) > 10:
        sentences.append(f"{np.count_nonzero(far) - 10} more positions are that far away")
    length = np.linalg.norm(listed.quats_as_read, axis=1)
    sentences += _sentence_on_rows(
        listed,
        np.abs(length - 1) > _UNIT_TO_THE_DIGITS,
        "quaternion was not unit and is normalised",
    )
    flipped = np.einsum("ni,ni->n", listed.quats_as_read, listed.poses.quats_wxyz) < 0
    sentences += _sentence_on_rows(
        listed,
        flipped,
        "quaternion has a negative scalar part; its sign is flipped (same rotation)",
    )
    _, first = np.unique(
        np.concatenate([listed.poses.centers, listed.poses.quats_wxyz], axis=1),
        axis=0,
        return_index=True,
    )
    duplicate = np.ones(len(listed), dtype=bool)
    duplicate[first] = False
    sentences += _sentence_on_rows(listed, duplicate, "exactly the same pose as an earlier image")
    return sentences


def _sentence_on_rows(listed: CambridgeList, rows: np.ndarray, sentence: str) -> list[str]:
    if not rows.any():
        return []
    more = f" and {np.count_nonzero(rows) - 1} more" if np.count_nonzero(rows) > 1 else ""
    return [f"{listed.names[int(np.argmax(rows))]}{more}: {sentence}"]


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line number and stripped text; raise InputError for overlong lines."""
    with path.open("rb") as file:
        number = 0
        while raw := file.readline(_MAX_LINE_BYTES + 1):
            number += 1
            if len(raw) > _MAX_LINE_BYTES:
                raise InputError(
                    f"the line is longer than {_MAX_LINE_BYTES} bytes", path=path, line=number
                )
            try:
                text = raw.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                raise InputError("the line is not UTF-8 text", path=path, line=number) from error
            yield number, text.strip()


def _header_line(path: Path, k: int, text: str | None) -> str:
    is_right = (
        text is not None
        and (
            text.startswith("Visual Landmark Dataset"),
            text.startswith("ImageFile"),
            text == "",
        )[k]
    )
    if text is None or not is_right:
        raise InputError(
            f"{'nothing' if text is None else repr(text[:60])} instead of "
            f"{HEADER[k]!r}: a Cambridge list begins with three header lines",
            path=path,
            line=k + 1,
        )
    return text


def _rows(path: Path, lines: Iterator[tuple[int, str]]) -> dict[str, list[float]]:
    rows: dict[str, list[float]] = {}
    for number, text in lines:
        if not text:
            continue
        if len(rows) >= MAX_FRAMES:
            raise InputError(f"holds more than {MAX_FRAMES} images", path=path, line=number)
        try:
            name, values = _row(text)
            if name in rows:
                raise ValueError(f"{name} is listed twice")
        except ValueError as error:
            raise InputError(str(error), path=path, line=number) from error
        rows[name] = values
    return rows


def _row(text: str) -> tuple[str, list[float]]:
    cells = text.rsplit(None, 7)
    if len(cells) != 8 or (len(cells[0].split()) > 1 and not has_image_suffix(cells[0])):
        raise ValueError(f"{len(text.split())} fields, expected 8: path x y z qw qx qy qz")
    _check_name(cells[0], spaces=True)
    try:
        return cells[0], _pose(cells[1:])
    except ValueError as error:
        raise ValueError(f"{cells[0]}: {error}") from error


def _pose(cells: list[str]) -> list[float]:
    for cell in cells:
        if not _NUMBER.fullmatch(cell):
            raise ValueError(f"{cell[:40]!r} is not a number")
    values = [float(cell) for cell in cells]
    if not max(map(abs, values)) <= 1e15:
        raise ValueError("a number exceeds 1e15")
    length = float(np.linalg.norm(values[3:]))
    if length == 0:
        raise ValueError("the quaternion is zero, so the image has no pose: remove the line")
    if not abs(length - 1) <= _UNIT_AT_ALL:
        raise ValueError(
            f"the quaternion has length {length:.6g} instead of 1: check the order of the columns"
        )
    return values


def _check_name(name: str, *, spaces: bool = False) -> None:
    """Raise ValueError unless the name is a relative path below the list's folder."""
    parts = name.split("/")
    if (
        any(part in ("", ".", "..") for part in parts)
        or any(c in name for c in '\\:"<>|?*')
        or any((c.isspace() and not (spaces and c == " ")) or not c.isprintable() for c in name)
        or len(name) > 1024
    ):
        raise ValueError(f"{name[:80]!r} is not a path below the list's folder")
