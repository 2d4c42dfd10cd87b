"""Completion of areas, runs, sequences and recipes in the shell; reads names of folders, and no file."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from spn_data.area.names import COMPARED, EVALUATION, FRAMES, RUNS, TRACKED

_MOST = 200  # names looked at in a folder
_NOT_SEQUENCES = ("masks", "telemetry")


def areas(context: click.Context, option: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the areas up to two folders below what was typed; folders where there is none."""
    typed, _, begun = incomplete.rpartition("/")
    base = Path(f"{typed}/" if typed or incomplete.startswith("/") else ".")
    found = []
    for folder in _folders(base):
        if folder.name.startswith(begun):
            found += [one for one in (folder, *_folders(folder)) if _is_area(one)]
    return [CompletionItem(str(one)) for one in found] or [CompletionItem(incomplete, type="dir")]


def runs(context: click.Context, option: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the runs of the area of `--area`."""
    names = [f.name for f in _folders(_area(context) / RUNS) if f.name != COMPARED]
    return _items(names, incomplete)


def sequences(
    context: click.Context, option: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the mapping and evaluation sequences of the area of `--area`."""
    folders = [f for g in (FRAMES, EVALUATION, TRACKED) for f in _folders(_area(context) / g)]
    return _items([f.name for f in folders if f.name not in _NOT_SEQUENCES], incomplete)


def recipes(
    context: click.Context, option: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the recipes of the package; files where none begins like that."""
    from spn_model.training.recipe import names

    found = _items(list(names()), incomplete)
    return found or [CompletionItem(incomplete, type="file")]


def _items(names: list[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in sorted(set(names)) if name.startswith(incomplete)]


def _area(context: click.Context) -> Path:
    return Path(context.params.get("area_folder") or ".")


def _is_area(folder: Path) -> bool:
    return (folder / FRAMES).is_dir()


def _folders(base: Path) -> Iterator[Path]:
    """Yield the folders in a folder, sorted; none if it cannot be read."""
    try:
        found = sorted(islice(base.iterdir(), _MOST))
    except OSError:
        return
    named = (path for path in found if path.name.isprintable() and path.name[0] != ".")
    yield from (path for path in named if path.is_dir())
