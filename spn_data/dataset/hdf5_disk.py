"""File object for HDF5 that defers disk errors, such as a full disk."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any


class DeferredErrorFile(io.RawIOBase):
    """File for h5py that records the first disk error and silently accepts all later writes.

    HDF5 cannot abandon a file whose last bytes cannot be written: it retries at process exit and crashes.
    This class therefore reports success to HDF5, and the caller has to check `error`.
    """

    def __init__(self, path: Path):
        super().__init__()
        self.error: OSError | None = None
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._position = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the position and return it."""
        if whence == os.SEEK_END:
            offset += os.fstat(self._descriptor).st_size
        elif whence == os.SEEK_CUR:
            offset += self._position
        self._position = offset
        return offset

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def readable(self) -> bool:
        """Return True."""
        return True

    def writable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer from the position; bytes that are not on the disk read as zero."""
        view = memoryview(buffer).cast("B")
        read = 0
        if self.error is None:
            read = os.preadv(self._descriptor, [view], self._position)
        view[read:] = bytes(len(view) - read)  # never written: zeros, as in a sparse file
        self._position += len(view)
        return len(view)

    def write(self, buffer: Any) -> int:
        """Write the buffer unless an error has occurred, and return its full length."""
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
        """Set the size of the file unless an error has occurred."""
        size = self._position if size is None else size
        try:
            if self.error is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = error
        return size

    def sync(self) -> None:
        """Flush to the disk; raise OSError if any write has failed."""
        if self.error is not None:
            raise self.error
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file without flushing it to the disk."""
        if not self.closed:
            os.close(self._descriptor)
        super().close()
