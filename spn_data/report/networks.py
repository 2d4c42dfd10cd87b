"""The networks of an area beside what needs none: tables, figures, and how short a training was."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape

from spn_data.report.data import MethodErrors, NetworkFacts, ReportData, RunFacts

# A training that has shown fewer images is called short: two cores show several times as many in 30 minutes.
SHORT_IMAGES = 30_000
_ROLES = {"test": "test frames", "validation": "validation frames", "train": "training images"}
_ORDER = tuple(_ROLES)
_NOTHING = "&ndash;"


def networks(data: ReportData) -> str:
    """Tables with all networks of one data set and one world, then each run's figures."""
    if not data.runs and not data.broken_runs:
        return ""
    parts = ['<section id="networks"><h2>Networks</h2>']
    parts += [f'<p class="note warn">{escape(text)}</p>' for text in data.broken_runs]
    single = [run for run in data.runs if len(run.networks) == 1]
    # What was judged on other frames stands in a table of its own.
    for dataset in dict.fromkeys(
        run.dataset for run in sorted(single, key=lambda r: not r.is_current)
    ):
        runs = [run for run in single if run.dataset == dataset]
        if not runs[0].is_current:
            parts.append(
                '<p class="note warn">Judged on an earlier data set than the area holds now: '
                f"{escape(', '.join(run.name for run in runs))}.</p>"
            )
        parts.append(_trained(runs))
        parts += _tables(runs)
    for run in data.runs:
        if run.is_outdated:
            parts.append(
                f'<p class="note warn">{escape(run.name)}: trained since it was judged; '
                "run spn-model evaluate again.</p>"
            )
        else:
            parts.append(_figures(run, opened=run is data.runs[0]))
    return "".join(parts) + "</section>"


def _trained(runs: Iterable[RunFacts]) -> str:
    """What each network is and how long it was trained; short trainings are named as such."""
    rows, short = [], []
    for run in runs:
        for name, network in run.networks.items():
            rows.append((escape(name), *_described(network)))
            if network.images is not None and network.images < SHORT_IMAGES:
                short.append(f"{name} ({network.images:,} images)")
    header = (
        *("network", "kind", "parameters", "size", "trained for", "kept after", "images seen"),
        "a pose takes",
    )
    told = (
        f'<p class="note warn">A short training: {escape(", ".join(short))}. What a longer one would give '
        "is not known from this.</p>"
        if short
        else ""
    )
    return _table(header, rows, "trained") + told


def _described(network: NetworkFacts) -> tuple[str, ...]:
    def told(value: float | None, form: str, unit: str) -> str:
        return _NOTHING if value is None else f"{value:{form}}{unit}"

    size = None if network.size_bytes is None else network.size_bytes / 1e6
    return (
        escape(network.kind),
        told(network.parameters, ",", ""),
        told(size, ".1f", " MB"),
        told(network.minutes, ".1f", " min"),
        told(network.kept_minutes, ".1f", " min"),
        told(network.images, ",", ""),
        told(network.ms_an_image, ".1f", " ms"),
    )


def _tables(runs: list[RunFacts]) -> list[str]:
    """A table a group: networks first, then what needs none, the paper's at the end."""
    names = {name: runs[0].groups[name][0] for name in runs[0].groups}
    order = sorted(names, key=lambda n: (_ORDER.index(names[n]) if names[n] in _ORDER else 9, n))
    return [_group(name, names[name], runs) for name in order]


def _group(name: str, role: str, runs: list[RunFacts]) -> str:
    of_networks: dict[str, MethodErrors] = {}
    beside: dict[str, MethodErrors] = {}
    for run in runs:
        for method, errors in run.groups.get(name, ("", {}))[1].items():
            is_network = any(method == n or method.startswith(f"{n}, ") for n in run.networks)
            (of_networks if is_network else beside).setdefault(method, errors)
    first = next(iter({**of_networks, **beside}.values()), None)
    if first is None:
        return ""
    unit = "m" if runs[0].units == "m" else "units"
    better = next((run.retrieval[name] for run in runs if name in run.retrieval), "")
    ordered = {**of_networks, **{m: beside[m] for m in sorted(beside, key=_rank)}}
    rows = [
        (_bold(method, method in of_networks, method == better), *_cells(errors, first, unit))
        for method, errors in ordered.items()
    ]
    published = [row for row in runs[0].published if row[1] == name]
    width = len(rows[0])
    rows += [
        (
            f"{escape(network)}, in the paper*",
            _NOTHING,
            f"{position:.2f} m, {rotation:.1f}&deg;",
            *[""] * (width - 3),
        )
        for network, _, position, rotation in published
    ]
    header = (
        *("method", "poses", "median", "mean", "p95"),
        *(f"{limit:g} {unit}, {deg:g}\N{DEGREE SIGN}" for limit, deg, _ in first.within),
        *(f"{axis} ({unit})" for axis, _ in first.signed[-1:]),
        "covariance",
    )
    note = (
        "* In another court, with other cameras; whether means or medians is not said. "
        if published
        else ""
    )
    return (
        f"<h3>{escape(name)}: {first.frames:,} {escape(_ROLES.get(role, role))}</h3>"
        f"{_table(header, rows, 'errors')}"
        f'<p class="note">{note}Nothing is aligned. {_axis(first)}'
        "Covariance: median squared error over what is stated, 1 is right.</p>"
    )


def _axis(errors: MethodErrors) -> str:
    if not errors.signed:
        return ""
    name = errors.signed[-1][0]
    below = " (negative: too low)" if name == "up" else ""
    return f"{escape(name)}: median signed error, estimated minus true{below}. "


def _rank(method: str) -> tuple[int, str]:
    """From what knows least to what knows most."""
    kinds = ("mean", "retrieval", "nearest")
    return next((k for k, kind in enumerate(kinds) if method.startswith(kind)), 9), method


def _cells(errors: MethodErrors, first: MethodErrors, unit: str) -> list[str]:
    """Of the columns that `first` has."""
    pairs = [
        f"{position:.2f} {unit}, {rotation:.1f}&deg;"
        if position is not None and rotation is not None
        else _NOTHING
        for position, rotation in zip(errors.position, errors.rotation_deg, strict=True)
    ]
    shares = {(limit, deg): share for limit, deg, share in errors.within}
    found = [shares.get((limit, deg)) for limit, deg, _ in first.within]
    signed = [dict(errors.signed).get(axis) for axis, _ in first.signed[-1:]]
    return [
        f"{errors.located:,} of {errors.frames:,}",
        *pairs,
        *(_NOTHING if share is None else f"{share:.0%}" for share in found),
        *(_NOTHING if value is None else f"{value:+.2f}" for value in signed),
        "" if errors.ratio is None else f"{errors.ratio:.2f}",
    ]


def _bold(method: str, is_network: bool, is_better: bool) -> str:
    text = escape(method) + (" (the better)" if is_better else "")
    return f"<b>{text}</b>" if is_network else text


def _figures(run: RunFacts, *, opened: bool) -> str:
    """Figures as images: a browser runs no script of an image, and fetches nothing for it."""
    if not run.figures and not run.left_out:
        return ""
    shown = "".join(
        f'<figure><img alt="{escape(figure.caption, quote=True)}" width="{figure.width_px}" '
        f'src="data:image/svg+xml;base64,{base64.b64encode(figure.svg).decode("ascii")}"></figure>'
        for figure in run.figures
    )
    left_out = (
        f"{run.left_out} figures are left out: too large, or no figures. " if run.left_out else ""
    )
    told = left_out + " ".join(run.notes)
    return (
        f"<details{' open' if opened else ''}><summary>Figures of <b>{escape(run.name)}</b></summary>"
        f'<p class="note">{escape(told)}</p>{shown}</details>'
    )


def _table(header: tuple[str, ...], rows: Iterable[Iterable[str]], kind: str) -> str:
    """Cells are HTML already, as many in a row as there are titles."""
    cells = [tuple(row) for row in rows]
    if any(len(row) != len(header) for row in cells):
        raise ValueError(f"a row of {kind} does not fit {header}")
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in cells)
    return (
        f'<div class="wide"><table class="{kind}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
