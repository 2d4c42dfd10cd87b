"""Mutations of files: the same seed always gives the same bytes."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

MAX_BYTES = 20_000_000  # beyond every seed: a shorter limit would cut them all
TEXTS = (
    *(
        "NaN",
        "nan",
        "inf",
        "-inf",
        "-0",
        "0",
        "1e400",
        "-1e308",
        "1e-400",
        "1e9",
        "9" * 400,
        "0x10",
        "1_0",
    ),
    *(
        "-1",
        "1",
        "180.1",
        "-90.5",
        "4294967296",
        "9223372036854775808",
        "true",
        "null",
        '""',
        "[]",
        "{}",
    ),
    *(
        "../../etc/passwd",
        "/etc/passwd",
        "a\0b",
        "..",
        "C:\\x",
        "http://127.0.0.1/x",
        "ü" * 300,
        "\ufeff",
    ),
    *(
        "\u2028",
        "١٢٣",
        "\uff12",
        "\r",
        "\n",
        "\x85",
        "\ud7ff",
        "%s%n",
        "2026-02-30T25:61:61Z",
        "0000-00-00",
    ),
)
NUMBERS = (
    0,
    1,
    2,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63,
    2**64 - 1,
)
VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        1.5,
        1e308,
        -1e308,
        1e-320,
        2**31,
        2**63,
        2**64,
        10**99,
        "",
        "x",
        [],
        {},
    ),
    *(
        [None],
        {"x": None},
        [[[]]],
        float("nan"),
        float("inf"),
        "../../x",
        "a\0b",
        "9" * 500,
        [0] * 1000,
    ),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_CELL = re.compile(rb"[^,;\t\n<>\"=: ]+")


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return a copy with one to four mutations that suit its format, or that suit bytes of any kind."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        change = _of_structure(data) if rng.random() < 0.5 else None
        try:
            data = (change or _bytes)(data, rng)
        except Exception:  # an earlier mutation left nothing that this one applies to
            data = _bytes(data, rng)
    return data[:MAX_BYTES]


def _of_structure(data: bytes) -> Callable[[bytes, random.Random], bytes] | None:
    start = data.lstrip()[:1]
    if data[:4] == b"PK\3\4":
        return _zip
    if start in (b"{", b"["):
        return _json
    if data[8:9] == b"{" and len(data) > 16:
        return _safetensors
    if b"\0" not in data[:2000]:
        return _text
    return _numbers


def _bytes(data: bytes, rng: random.Random) -> bytes:
    """Flip, cut, double, remove, overwrite or insert bytes; half of the time near the start."""
    n = len(data)
    if not n:
        return bytes(rng.randrange(256) for _ in range(8))
    at = rng.randrange(min(n, 400) if rng.random() < 0.5 else n)
    size = min(n - at, rng.choice((1, 2, 4, 8, 16, 100, 1000, 20_000)))
    kind = rng.randrange(7)
    if kind == 0:
        flips = bytearray(data)
        for _ in range(rng.choice((1, 1, 4, 32))):
            place = (at + rng.randrange(64)) % n
            flips[place] ^= 1 << rng.randrange(8)
        return bytes(flips)
    if kind == 1:
        return data[:at]
    if kind == 2:
        return data[:at] + data[at : at + size] * rng.choice((2, 3, 50)) + data[at + size :]
    if kind == 3:
        return data[:at] + data[at + size :]
    if kind == 4:
        form = rng.choice(("<B", "<H", ">H", "<I", ">I", "<Q", ">Q"))
        width = struct.calcsize(form)
        value = rng.choice(NUMBERS) % 2 ** (8 * width)
        return data[:at] + struct.pack(form, value) + data[at + width :]
    if kind == 5:
        special = rng.choice((float("nan"), float("inf"), -1e308, 1e-320, 0.0))
        return data[:at] + struct.pack(rng.choice(("<d", ">d")), special) + data[at + 8 :]
    return data[:at] + rng.choice((b"\0", b"\xff\xfe", b"\xc3\x28", b"(" * 5000)) + data[at:]


def _numbers(data: bytes, rng: random.Random) -> bytes:
    """Exchange one number written in digits, such as those of metadata in a picture."""
    found = list(_NUMBER.finditer(data[:100_000]))
    match = rng.choice(found)
    return (
        data[: match.start()] + rng.choice(TEXTS).encode("utf-8", "replace") + data[match.end() :]
    )


def _text(data: bytes, rng: random.Random) -> bytes:
    """Exchange a number or a word, nest deeply, repeat or remove a line, or change the encoding."""
    kind = rng.randrange(7)
    if kind < 4:
        found = list((_NUMBER if kind < 2 else _CELL).finditer(data[:200_000]))
        match = rng.choice(found)
        return (
            data[: match.start()]
            + rng.choice(TEXTS).encode("utf-8", "replace")
            + data[match.end() :]
        )
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    if kind == 4:
        lines[at : at + 1] = [] if rng.random() < 0.5 else lines[at : at + 1] * rng.choice((2, 100))
        return b"\n".join(lines)
    if kind == 5:
        deep = (
            rng.choice((b"[", b"{", b'{"a":', b"<a>", b"(", b",", b" ", b'"', b"a.", b"a=["))
            * 20_000
        )
        lines[at] = lines[at] + deep
        return b"\n".join(lines)
    text = data.decode("utf-8", "replace")
    return text.encode(rng.choice(("utf-16", "utf-8-sig", "latin-1", "utf-32")), "replace")


def _json(data: bytes, rng: random.Random) -> bytes:
    return json.dumps(changed(json.loads(data), rng)).encode()


def changed(value: Any, rng: random.Random) -> Any:
    """Return plain values with one of them exchanged, removed, added or nested deeply."""
    places: list[tuple[Any, Any]] = []

    def visit(inner: Any) -> None:
        keys = list(inner) if isinstance(inner, dict) else range(min(len(inner), 200))
        for key in keys:
            places.append((inner, key))
            if isinstance(inner[key], dict | list):
                visit(inner[key])

    visit(value)
    holder, key = rng.choice(places)
    kind = rng.randrange(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[rng.choice(TEXTS)] = holder[key]
    elif kind == 2:
        deep: Any = 1
        for _ in range(900):
            deep = [deep]
        holder[key] = deep
    else:
        holder[key] = rng.choice(VALUES)
    return value


def _safetensors(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a safetensors file, also the JSON document in its metadata."""
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    document = header.get("__metadata__", {}).get("document")
    if document and rng.random() < 0.7:
        header["__metadata__"]["document"] = json.dumps(changed(json.loads(document), rng))
    else:
        header = changed(header, rng)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data[8 + length :]


def _zip(data: bytes, rng: random.Random) -> bytes:
    """Mutate, remove, double or rename one member of an archive, such as an array of an .npz."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = rng.choice(sorted(members))
    kind = rng.randrange(6)
    if kind == 0:
        del members[name]
    elif kind == 1:
        members["../" + name] = members.pop(name)
    elif kind < 4 and members[name][:6] == b"\x93NUMPY":
        members[name] = _array(members[name], rng)
    else:
        members[name] = _bytes(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return out.getvalue()


def _array(data: bytes, rng: random.Random) -> bytes:
    """Change the type or shape in the header of an .npy; the length of the header stays."""
    (length,) = struct.unpack_from("<H", data, 8)
    header, body = data[10 : 10 + length].decode("latin-1"), data[10 + length :]
    descr = rng.choice(
        ("<f8", "<i8", "|O", "<U8", "|S1", "<M8[s]", "|b1", "<c16", "<f2", "|V8", "<u8")
    )
    shape = rng.choice(
        ("()", "(0,)", "(99999999999,)", "(1, 1, 1)", "(-1,)", "(3, 0)", "(2,)", "(8, 2)")
    )
    if rng.random() < 0.5:
        header = re.sub(r"'descr': '[^']*'", f"'descr': '{descr}'", header)
    else:
        header = re.sub(r"'shape': \([^)]*\)", f"'shape': {shape}", header)
    return data[:10] + header.rstrip().ljust(length - 1)[: length - 1].encode() + b"\n" + body
