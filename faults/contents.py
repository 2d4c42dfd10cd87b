"""Contents of a folder as digests, without what differs between two undisturbed runs."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spn_data.area.names import GROUND, THUMBNAILS

_LEFT_OUT = (".lock", THUMBNAILS, GROUND)
_TIMES = re.compile(
    r"(^|_)(seconds|started|finished|versions|threads|created)$"
    r"|^(train_s|validate_s|wait_s|ms_an_image|images_per_s|load_s|run_s|written|size_bytes)$"
)
_TEXT_TIMES = re.compile(
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?(\+00:00|Z| UTC)?|\d+(\.\d+)? (s|ms|min|h)\b"
)


def contents(folder: Path, skip: Callable[[str], bool] = lambda _: False) -> dict[str, str]:
    """Return a digest for each file and folder below `folder`, by its path.

    Lock files, `skip` and pictures of the last report are left out: its page has them too.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name in _LEFT_OUT or skip(name):
            continue
        found[name] = "folder" if path.is_dir() else _digest(path, folder)
    return found


def _digest(path: Path, folder: Path) -> str:
    data = path.read_bytes()
    if path.suffix == ".json":
        data = _plain(json.loads(data.decode() or "null")).encode()
    elif path.suffix == ".safetensors":
        length = struct.unpack("<Q", data[:8])[0]
        header = json.loads(data[8 : 8 + length])
        about = {k: _parsed(v) for k, v in header.pop("__metadata__", {}).items()}
        data = (json.dumps(header) + _plain(about)).encode() + data[8 + length :]
    elif path.suffix == ".db":
        with sqlite3.connect(f"file:{path}?immutable=1", uri=True) as database:
            data = "\n".join(database.iterdump()).encode()
    elif path.name == "log.csv":
        rows = [line.split(",") for line in data.decode().splitlines()]
        kept = [k for k, name in enumerate(rows[0]) if not _TIMES.search(name)]
        data = "\n".join(",".join(row[k] for k in kept) for row in rows).encode()
    elif path.suffix in (".html", ".md", ".svg"):
        data = _TEXT_TIMES.sub("TIME", data.decode()).encode()
    return hashlib.sha256(data.replace(str(folder).encode(), b"WORK")).hexdigest()[:12]


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _plain(value: Any) -> str:
    """Return JSON of a value without times."""

    def strip(part: Any) -> Any:
        if isinstance(part, dict):
            return {k: strip(v) for k, v in part.items() if not _TIMES.search(k)}
        return [strip(v) for v in part] if isinstance(part, list) else part

    return json.dumps(strip(value), sort_keys=True)


def differences(one: dict[str, str], other: dict[str, str]) -> list[str]:
    """Return the paths that two contents do not share, marked - (missing), + (new) or ~ (changed)."""
    return [
        f"{'-' if name not in other else '+' if name not in one else '~'}{name}"
        for name in sorted(one.keys() | other.keys())
        if one.get(name) != other.get(name)
    ]
