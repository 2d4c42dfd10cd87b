"""Hard links instead of copies, if the file system allows."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a file to a new name; copy it, atomically, on file systems without hard links."""
    try:
        os.link(source, target)
    except OSError:
        copy = target.with_name(f"{target.name}.part")
        shutil.copy2(source, copy)
        copy.replace(target)
