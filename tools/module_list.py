"""List every module with the first line of its docstring, as docs/architecture.md shows it.

    python tools/module_list.py --write

replaces the list in docs/architecture.md; without --write, the list is printed.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("spn_data", "spn_model", "cli/spn_cli")
_BLOCK = re.compile(r"(?<=<!-- modules -->\n)```text\n.*?```\n", re.DOTALL)


def module_list() -> str:
    """Return the list: a heading for each folder, then its modules."""
    return "\n".join(line for package in PACKAGES for line in _folder(ROOT / package))


def with_list(page: str) -> str:
    """Return the page with its list replaced by the current one. Raises ValueError if it has none."""
    block = f"```text\n{module_list()}\n```\n"
    found, count = _BLOCK.subn(lambda _: block, page)
    if count != 1:
        raise ValueError("no list of modules after '<!-- modules -->'")
    return found


def _folder(folder: Path) -> Iterator[str]:
    yield f"{folder.relative_to(ROOT).as_posix()}/  {_summary(folder / '__init__.py')}".rstrip()
    for path in sorted(folder.glob("*.py")):
        if path.name != "__init__.py":
            yield f"  {path.name:<24} {_summary(path)}"
    yield ""
    for child in sorted(p for p in folder.iterdir() if (p / "__init__.py").is_file()):
        yield from _folder(child)


def _summary(path: Path) -> str:
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(doc.split("\n\n")[0].split()).rstrip(".")


def main() -> None:
    """Print the list, or write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="replace the list in the page")
    if parser.parse_args().write:
        PAGE.write_text(with_list(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print(module_list())


if __name__ == "__main__":
    main()
