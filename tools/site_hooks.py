"""Hooks of the documentation site: README.md is its first page, links out of docs/ stay as text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"\[([^\]]+)\]\(([^)\s]+)\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the README as index.md."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=_in_site(text, "docs/")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point links to the README to the first page; drop links to files that the site does not hold."""
    return markdown if page.file.src_uri == "index.md" else _in_site(markdown, "")


def _in_site(text: str, prefix: str) -> str:
    """Rewrite links that are relative to a folder of the repository: `prefix` is the way to docs/ from it."""

    def rewrite(found: re.Match[str]) -> str:
        label, target = found[1], found[2]
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        if target.startswith("../README.md"):
            return f"[{label}](index.md{target.removeprefix('../README.md')})"
        if prefix and target.startswith(prefix):
            return f"[{label}]({target.removeprefix(prefix)})"
        is_outside = prefix or target.startswith("../")
        return f"`{label}`" if is_outside and not target.startswith("../api/") else found[0]

    return _LINK.sub(rewrite, text)
