"""Trained networks for the report: metrics.json and figures of each run, read as untrusted files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spn_data.area.area import Area
from spn_data.area.names import (
    BUNDLE,
    BUNDLE_FACTS,
    CHECKPOINT,
    COMPARED,
    CONFIG,
    DATASET,
    FIGURES,
    METRICS,
    RUNS,
    SPLIT,
)
from spn_data.capture.sources import safe_name
from spn_data.errors import FormatError, InputError
from spn_data.report.fix_facts import BundleFixes, FixFigures
from spn_data.report.network_state import NetworkState
from spn_data.report.run_facts import Figure, MethodErrors, NetworkFacts, RunFacts
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import DAMAGE, finite_or_none, load_json, text_of

_VERSION = 1  # format of metrics.json
_MAX_BYTES = 20_000_000
_MAX_FIGURE_BYTES = 3_000_000
_MAX_FIGURES_BYTES = 12_000_000  # in all runs
_MAX_RUNS, _MAX_FIGURES = 50, 60
_MAX_TEXT = 200
_MAX_FIX_ROWS, _MAX_REASON = 100, 600
_KINDS = ("protection", "trajectories", "histograms", "distance", "calibration")
_SVG = re.compile(rb'<svg [^<>]*?viewBox="0 0 (\d{1,5}) \d{1,5}"')


def read_runs(area: Area) -> tuple[tuple[RunFacts, ...], tuple[str, ...]]:
    """Read the evaluated runs of an area.

    Parameters
    ----------
    area : Area

    Returns
    -------
    runs : tuple of RunFacts
        Runs with metrics.json: comparisons of several networks first, then by name.
    broken : tuple of str
        Why other runs cannot be shown.
    """
    folder = area.root / RUNS
    names = [n for n in area.sequences(RUNS) if (folder / n / METRICS).is_file()]
    names.sort(key=lambda name: (name != COMPARED, name))
    dataset = area.folder(SPLIT) / DATASET
    current = content_fingerprint(dataset) if dataset.is_file() else ""
    found: list[RunFacts] = []
    broken: list[str] = []
    budget = _MAX_FIGURES_BYTES
    for name in names[:_MAX_RUNS]:
        try:
            run = _read(folder / name, current, budget)
        except FormatError as error:
            broken.append(str(error))
            continue
        budget -= sum(len(figure.svg) for figure in run.figures)
        found.append(run)
    if len(names) > _MAX_RUNS:
        broken.append(f"{len(names) - _MAX_RUNS} more runs are not shown.")
    return tuple(found), tuple(broken)


def trained_runs(area: Area, runs: Sequence[RunFacts]) -> tuple[NetworkState, ...]:
    """Return the state of the trained networks of an area, the newest first; `runs` are evaluated ones."""
    evaluated = {
        name for run in runs if run.is_current and not run.is_outdated for name in run.networks
    }
    made_of = {run.name: run.fixes.made_of for run in runs}
    found = []
    for name in area.sequences(RUNS):
        folder = area.root / RUNS / name
        checkpoint, bundle = folder / CHECKPOINT, folder / BUNDLE
        if not checkpoint.is_file() or name == COMPARED:
            continue
        facts = bundle_facts(bundle / BUNDLE_FACTS)
        state = NetworkState(
            name,
            f"{RUNS}/{name}/{BUNDLE}",
            recipe=_recipe(folder / CONFIG),
            is_evaluated=name in evaluated,
            has_bundle=bundle.is_dir(),
            is_exported=facts.get("checkpoint") == content_fingerprint(checkpoint),
            has_landmarks="landmarks" in facts,
            is_measured="landmarks" in facts
            and all(
                made_of.get(name, {}).get(part) == facts[part] for part in ("network", "landmarks")
            ),
        )
        found.append((checkpoint.stat().st_mtime, state))
    return tuple(run for _, run in sorted(found, key=lambda one: (-one[0], one[1].name)))


def bundle_facts(path: Path) -> dict[str, str]:
    """Return the fingerprint of the `checkpoint` of a bundle, and SHA-256 of its `network` and `landmarks`.

    Empty if there is none, or a damaged one, which every command that uses it refuses.
    """
    if not path.is_file():
        return {}
    try:
        document = load_json(path, max_bytes=_MAX_BYTES)
        facts = {
            "checkpoint": _text(document["run"]["checkpoint"]),
            "network": _text(document["graphs"]["float32"]["sha256"]),
        }
        if "landmarks" in document:
            facts["landmarks"] = _text(document["landmarks"]["sha256"])
        return facts
    except (*DAMAGE, FormatError):
        return {}


def _recipe(path: Path) -> str:
    """Return the recipe that config.json of a run names; empty if it names none."""
    try:
        return _text(load_json(path, max_bytes=_MAX_BYTES)["recipe"])
    except (*DAMAGE, OSError, FormatError):
        return ""


def _read(folder: Path, current: str, budget: int) -> RunFacts:
    path = folder / METRICS
    try:
        table = load_json(path, max_bytes=_MAX_BYTES)
        if table["version"] != _VERSION:
            raise ValueError(f"format version {table['version']!r}, this program reads {_VERSION}")
        facts = table["facts"]
        figures, left_out = _figures(folder / FIGURES, budget)
        dataset = _text(facts["dataset"])
        networks = {
            _text(name): _network(of, facts["costs"].get(name, {}))
            for name, of in facts["runs"].items()
        }
        return RunFacts(
            name=folder.name,
            units=_text(table["units"]),
            dataset=dataset,
            is_current=dataset == current,
            is_outdated=any(
                _checkpoint(folder.parent, name) != network.checkpoint
                for name, network in networks.items()
            ),
            networks=networks,
            groups={
                _text(name): (
                    _text(facts["roles"][name]),
                    {_text(method): _errors(value) for method, value in methods.items()},
                )
                for name, methods in table["groups"].items()
            },
            retrieval={_text(k): _text(v) for k, v in table["retrieval"].items()},
            published=tuple(
                (
                    _text(row["network"]),
                    _text(row["sequence"]),
                    _required(row["position_m"]),
                    _required(row["rotation_deg"]),
                )
                for row in table["paper"]["table_1"][:100]
            ),
            notes=tuple(_text(note) for note in facts["notes"][:50]),
            figures=figures,
            left_out=left_out,
            fixes=_fixes(table["fixes"]) if "fixes" in table else BundleFixes(),
        )
    except (*DAMAGE, OSError, FormatError, InputError) as error:
        raise FormatError(
            f"{path}: cannot be shown ({str(error)[:_MAX_TEXT]!r}); run spn-model evaluate again"
        ) from error


def _checkpoint(runs: Path, name: str) -> str:
    """Return the fingerprint of the present network of a run; empty if there is none."""
    if safe_name(name) != name:
        raise ValueError("a network name that is not a run name")
    path = runs / name / CHECKPOINT
    return content_fingerprint(path) if path.is_file() else ""


def _network(of: Mapping[str, Any], cost: Mapping[str, Any]) -> NetworkFacts:
    training, course = of["training"], of.get("course") or {}
    seconds = _number(training.get("train_s"))
    return NetworkFacts(
        kind=_text(of["kind"]),
        checkpoint=_text(of["checkpoint"]),
        parameters=_count(of["parameters"]),
        size_bytes=_count(of["bytes"]),
        images=_count(course.get("images", training.get("images_shown"))),
        minutes=_number(course.get("minutes", None if seconds is None else seconds / 60)),
        kept_minutes=None if seconds is None else seconds / 60,
        ms_an_image=_number(cost.get("ms_an_image")),
    )


def _errors(value: Mapping[str, Any]) -> MethodErrors:
    kinds = ("median", "mean", "p95")
    calibration = value["calibration"]
    return MethodErrors(
        frames=int(_required(value["frames"])),
        located=int(_required(value["located"])),
        position=tuple(_number(value["position"][kind]) for kind in kinds),
        rotation_deg=tuple(_number(value["rotation_deg"][kind]) for kind in kinds),
        within=tuple(
            (_required(part["limit"]), _required(part["limit_deg"]), _required(part["share"]))
            for part in value["within"][:10]
        ),
        signed=tuple(
            (_text(part["axis"]), _number(part["signed_median"])) for part in value["axes"][:3]
        ),
        ratio=None if calibration is None else _number(calibration["ratio"]),
    )


def _fixes(value: Mapping[str, Any]) -> BundleFixes:
    rows = [
        FixFigures(
            flight=_text(flight),
            method=_text(method),
            images=int(_required(of["images"])),
            usable=int(_required(of["usable"])),
            compared=int(_required(of["compared"])),
            error_m=_number(of["error_m"]),
            error_deg=_number(of["error_deg"]),
            misleading=int(_required(of["misleading"])),
            misleading_at_most=_required(of["misleading_at_most"]),
            nees=_number(of["nees"]),
            protected=_number(of["protected"]),
            longest_outage_s=_number(of["longest_outage_s"]),
            from_network=_count(of.get("from_network")),
        )
        for flight, methods in value["flights"].items()
        for method, of in methods.items()
    ]
    attitudes = [_text(one, _MAX_REASON) for one in value.get("attitudes", ())[:_MAX_FIX_ROWS]]
    return BundleFixes(
        rows=tuple(rows[:_MAX_FIX_ROWS]),
        reason=_text(value["reason"], _MAX_REASON),
        made_of={_text(part): _text(digest) for part, digest in value["bundle"].items()},
        attitudes=tuple(attitudes),
    )


def _figures(folder: Path, budget: int) -> tuple[tuple[Figure, ...], int]:
    """Return the figures of a folder, and how many are left out: too large, or not of this program."""
    if not folder.is_dir() or folder.is_symlink():
        return (), 0
    found: list[Figure] = []
    left_out = 0
    for path in sorted(folder.glob("*.svg"), key=_reading_order):
        is_regular = path.is_file() and not path.is_symlink()
        size = path.stat().st_size if is_regular else 0
        if not is_regular or size > min(_MAX_FIGURE_BYTES, budget) or len(found) >= _MAX_FIGURES:
            left_out += 1
            continue
        content = path.read_bytes()
        head = _SVG.match(content)
        if head is None:
            left_out += 1
            continue
        budget -= size
        group, _, what = path.stem.rpartition("-")
        caption = f"{group}: {what}" if group else what
        found.append(Figure(_text(caption), int(head[1]), content))
    return tuple(found), left_out


def _reading_order(path: Path) -> tuple[bool, str, int, str]:
    """Return a sort key: the training curve first, then the figures of each group."""
    group, _, what = path.stem.rpartition("-")
    return path.stem != "training", group, _KINDS.index(what) if what in _KINDS else 9, path.stem


def _text(value: Any, most: int = _MAX_TEXT) -> str:
    return text_of(value, most)


def _number(value: Any) -> float | None:
    """Return a number, or None if it is unknown."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{type(value).__name__} instead of a number")
    return finite_or_none(value)


def _required(value: Any) -> float:
    number = _number(value)
    if number is None:
        raise ValueError("a required number is missing")
    return number


def _count(value: Any) -> int | None:
    number = _number(value)
    return None if number is None else int(number)
