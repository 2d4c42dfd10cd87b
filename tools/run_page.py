"""Run the Python code blocks of a Markdown page in order, in one namespace, as a notebook would.

    python tools/run_page.py docs/python.md

The paths on the page are those of `make demo`. Stops with the traceback of the first block that fails.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

_BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def run_page(path: Path) -> int:
    """Run all blocks of a page; return their number."""
    text = path.read_text(encoding="utf-8")
    namespace: dict[str, object] = {"__name__": "__main__"}
    blocks = list(_BLOCK.finditer(text))
    for found in blocks:
        first = text.count("\n", 0, found.start(1))
        exec(compile("\n" * first + found[1], str(path), "exec"), namespace)
    return len(blocks)


def main() -> None:
    """Run the pages given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", type=Path, nargs="+")
    for page in parser.parse_args().pages:
        print(f"{page}: {run_page(page)} blocks run")


if __name__ == "__main__":
    main()
