"""The file that HDF5 writes to, behind which a full disk may stand."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any


class Disk(io.RawIOBase):
    """A file for h5py that keeps the first error of the disk, and takes everything from then on.

    HDF5 can't give up a file whose last bytes don't reach the disk: it tries again at the end of the
    process, and crashes it. So it is told that all went well, and `error` is for its user to look at.
    """

    def __init__(self, path: Path):
        super().__init__()
        self.error: OSError | None = None
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._position = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset += os.fstat(self._descriptor).st_size
        elif whence == os.SEEK_CUR:
            offset += self._position
        self._position = offset
        return offset

    def tell(self) -> int:
        return self._position

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        read = 0
        if self.error is None:
            read = os.preadv(self._descriptor, [view], self._position)
        view[read:] = bytes(len(view) - read)  # never written: zeros, as in any file with a hole
        self._position += len(view)
        return len(view)

    def write(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        written = 0
        try:
            while written < len(view) and self.error is None:
                rest, position = view[written:], self._position + written
                written += os.pwrite(self._descriptor, rest, position)
        except OSError as error:
            self.error = error
        self._position += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        try:
            if self.error is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = error
        return size

    def sync(self) -> None:
        """Raises OSError where what was written is not on the disk."""
        if self.error is not None:
            raise self.error
        os.fsync(self._descriptor)

    def close(self) -> None:
        if not self.closed:
            os.close(self._descriptor)
        super().close()
