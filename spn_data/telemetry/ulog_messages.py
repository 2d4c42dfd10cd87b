"""A pass over a ULog that keeps only the messages needed, so that a large log takes little memory."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

MAX_MESSAGE_BYTES = 256_000_000  # of the messages needed
_HEADER_BYTES = 16
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_BLOCK_BYTES = 4_000_000
_MAX_UNKNOWN_BYTES = 10_000  # of a message of a kind from the future
_KINDS = frozenset(b"BFIMPQARDLCSO")
_FLAGS, _FORMAT, _ADD, _DATA = b"BFAD"


@dataclass(frozen=True)
class NeededMessages:
    """A ULog of the messages needed, the number of damaged bytes, and whether it was too large."""

    data: bytes
    skipped_bytes: int
    is_full: bool


def needed_messages(path: Path, names: Collection[str]) -> NeededMessages:
    """Return the formats of a ULog and the messages of the given names.

    Parameters
    ----------
    path : Path
        The log.
    names : collection of str
        Names of messages.

    Returns
    -------
    NeededMessages
        After damage it goes on with the next synchronisation or the next message of a kind found before. A
        message that the end of the file cuts counts as damage.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    scan = _Scan(frozenset(name.encode() for name in names))
    with path.open("rb") as file:
        scan.out.extend(file.read(_HEADER_BYTES))
        while block := file.read(_BLOCK_BYTES):
            scan.add(block)
    return NeededMessages(bytes(scan.out), scan.skipped_bytes + len(scan.rest), scan.is_full)


class _Scan:
    """The messages needed of the blocks so far."""

    def __init__(self, names: frozenset[bytes]):
        self._names = names
        self._starts: dict[int, bytes] = {}  # first bytes of the data messages of each identifier
        self.rest = b""
        self.out = bytearray()
        self.skipped_bytes = 0
        self.is_full = False

    def add(self, block: bytes) -> None:
        """Add the next block; a message that it cuts waits for the one after it."""
        data, at, starts = self.rest + block, 0, self._starts
        end = len(data)
        while at + 5 <= end:
            size, kind = data[at] | data[at + 1] << 8, data[at + 2]
            if not size or (kind not in _KINDS and (not kind or size > _MAX_UNKNOWN_BYTES)):
                at = self._after_damage(data, at)
                continue
            after = at + 3 + size
            if after > end:
                break
            if kind == _DATA:
                number = data[at + 3] | data[at + 4] << 8
                if number in starts:
                    starts[number] = starts[number] or data[at : at + 5]
                    self._keep(data[at:after])
            elif kind == _ADD:
                number, name = data[at + 4] | data[at + 5] << 8, data[at + 6 : after]
                if name in self._names:
                    starts[number] = b""
                    self._keep(data[at:after])
                else:
                    starts.pop(number, None)
            elif kind in (_FORMAT, _FLAGS):
                self._keep(data[at:after])
            at = after
        self.rest = data[at:]

    def _keep(self, message: bytes) -> None:
        self.is_full |= len(self.out) + len(message) > MAX_MESSAGE_BYTES
        if not self.is_full:
            self.out.extend(message)

    def _after_damage(self, data: bytes, at: int) -> int:
        """Return where to go on after damage, and count the bytes between."""
        patterns = [start for start in self._starts.values() if start]
        found = [data.find(pattern, at + 1) for pattern in patterns]
        sync = data.find(_SYNC, at)
        found.append(sync + len(_SYNC) if sync >= 0 else -1)
        # Without any, the last bytes may be the beginning of one that the next block completes.
        after = min((one for one in found if one >= 0), default=max(at + 1, len(data) - 7))
        self.skipped_bytes += after - at
        return after
