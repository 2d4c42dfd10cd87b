"""Hash over all files of a map, to prove that it has not changed."""

from __future__ import annotations

import hashlib
from pathlib import Path


def map_hash(folder: Path) -> str:
    """Return the SHA-256 over the names, sizes and contents of all files in a folder, sorted by name."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(f"{path.relative_to(folder).as_posix()}\0{path.stat().st_size}\0".encode())
        with path.open("rb") as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()
