"""Proof that a map has not changed: a hash of every byte of its files."""

from __future__ import annotations

import hashlib
from pathlib import Path


def map_hash(folder: Path) -> str:
    """SHA-256 over the names and contents of all files of a stage of the map, in the order of names."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(f"{path.relative_to(folder).as_posix()}\0{path.stat().st_size}\0".encode())
        with path.open("rb") as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()
