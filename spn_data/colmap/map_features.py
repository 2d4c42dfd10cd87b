"""Read-only access to the descriptors in a COLMAP database that must not change.

COLMAP itself writes to a database when it only opens it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self
from urllib.parse import quote

import numpy as np

from spn_data.errors import FormatError

_DESCRIPTOR_BYTES = 128
_KEYPOINT_VALUES = 4  # x, y, scale, orientation
_MAX_ROWS = 1_000_000


class MapFeatures:
    """Descriptors by image name, read through SQLite from an immutable file."""

    def __init__(self, path: Path, connection: sqlite3.Connection):
        self._path = path
        self._connection = connection

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[Self]:
        """Open a database for reading.

        Parameters
        ----------
        path : Path
            Database file.

        Yields
        ------
        MapFeatures
            Closed when the context exits.

        Raises
        ------
        FormatError
            If the database cannot be opened.
        """
        try:
            uri = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
            connection = sqlite3.connect(uri, uri=True)
        except sqlite3.Error as error:
            raise FormatError(f"{path}: cannot be opened ({error})") from error
        try:
            yield cls(path, connection)
        finally:
            connection.close()

    def descriptors(self, name: str) -> np.ndarray:
        """Read the descriptors of an image.

        Parameters
        ----------
        name : str
            Image name.

        Returns
        -------
        ndarray, shape (K, 128), uint8
            In the order of the image's features in the model.

        Raises
        ------
        FormatError
            If the image has no descriptors, or they are damaged or unreadable.
        """
        return self._read("descriptors", name, np.uint8, _DESCRIPTOR_BYTES)

    def scales(self, name: str) -> np.ndarray:
        """Read the scales of the features of an image, in pixels.

        Parameters
        ----------
        name : str
            Image name.

        Returns
        -------
        ndarray, shape (K,), float32

        Raises
        ------
        FormatError
            As `descriptors`.
        """
        return self._read("keypoints", name, np.float32, _KEYPOINT_VALUES)[:, 2]

    def _read(self, table: str, name: str, kind: type[np.generic], width: int) -> np.ndarray:
        query = (
            f"SELECT t.rows, t.cols, t.data FROM {table} t JOIN images i USING (image_id) "
            "WHERE i.name = ?"
        )
        try:
            row = self._connection.execute(query, (name,)).fetchone()
        except sqlite3.Error as error:
            raise FormatError(f"{self._path}: cannot be read ({error})") from error
        if row is None:
            raise FormatError(f"{self._path}: contains no features of {name}")
        rows, columns, data = row
        size = rows * columns * np.dtype(kind).itemsize
        if columns != width or not 0 <= rows <= _MAX_ROWS or len(data or b"") != size:
            raise FormatError(f"{self._path}: the {table} of {name} are damaged")
        return np.frombuffer(data or b"", kind).reshape(-1, width)
