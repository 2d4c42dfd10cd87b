"""Byte transports to an autopilot: UDP, and a serial line on POSIX."""

from __future__ import annotations

import os
import select
import socket
from pathlib import Path
from typing import Protocol

from spn_data.errors import InputError

MAX_DATAGRAM = 65_535
_READ = 4096
_FORMS = "udpout:HOST:PORT, udpin:HOST:PORT or serial:DEVICE:BAUD"


class Transport(Protocol):
    """Sends and receives bytes without waiting.

    Attributes
    ----------
    is_stream : bool
        Whether a message may come in several pieces.
    """

    is_stream: bool

    def send(self, data: bytes) -> None:
        """Send bytes; raise OSError if that fails."""

    def wait(self, seconds: float) -> bool:
        """Wait until something may have arrived; return whether it may."""

    def receive(self) -> bytes:
        """Return what has arrived, or nothing; raise OSError if that fails."""

    def close(self) -> None:
        """Close."""


class Udp:
    """UDP: as a client of one address, or as a server that answers the last sender."""

    is_stream = False

    def __init__(self, host: str, port: int, *, server: bool):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._server = server
        self._peer: tuple[str, int] | None = None
        try:
            if server:
                self._socket.bind((host, port))
            else:
                self._socket.connect((host, port))  # takes datagrams of no other address
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise

    def send(self, data: bytes) -> None:
        """Send a datagram; nothing is sent before a server knows to whom."""
        if not self._server:
            self._socket.send(data)
        elif self._peer is not None:
            self._socket.sendto(data, self._peer)

    def wait(self, seconds: float) -> bool:
        """Wait for a datagram."""
        return bool(select.select([self._socket], [], [], seconds)[0])

    def receive(self) -> bytes:
        """Return the next datagram."""
        try:
            data, sender = self._socket.recvfrom(MAX_DATAGRAM)
        except BlockingIOError:
            return b""
        self._peer = sender
        return data

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Serial:
    """A serial line, 8 data bits, no parity, without flow control."""

    is_stream = True

    def __init__(self, device: Path, baud: int):
        import termios

        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise InputError(f"a serial line cannot have {baud} baud here")
        self._file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            raw = termios.CS8 | termios.CREAD | termios.CLOCAL
            characters = termios.tcgetattr(self._file)[6]
            termios.tcsetattr(self._file, termios.TCSANOW, [0, 0, raw, 0, speed, speed, characters])
        except termios.error as error:
            os.close(self._file)
            raise InputError(f"is no serial line: {error}", path=device) from error

    def send(self, data: bytes) -> None:
        """Write bytes; what the line cannot take at once is dropped whole by the receiver's checksum."""
        os.write(self._file, data)

    def wait(self, seconds: float) -> bool:
        """Wait for bytes."""
        return bool(select.select([self._file], [], [], seconds)[0])

    def receive(self) -> bytes:
        """Return the bytes that have arrived."""
        try:
            return os.read(self._file, _READ)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def open_transport(url: str) -> Transport:
    """Open `udpout:HOST:PORT`, `udpin:HOST:PORT` or `serial:DEVICE:BAUD`; raise InputError if impossible."""
    kind, _, rest = url.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in ("udpout", "udpin", "serial") or not place or not number.isdecimal():
        raise InputError(f"'{url}' is no connection: give {_FORMS}")
    value = int(number[:9])
    try:
        if kind == "serial":
            return Serial(Path(place), value)
        if not 0 < value < 65536:
            raise InputError(f"'{url}' has no port of 1 to 65535: give {_FORMS}")
        return Udp(place, value, server=kind == "udpin")
    except (OSError, ImportError) as error:
        raise InputError(f"'{url}' cannot be opened: {error}") from error
