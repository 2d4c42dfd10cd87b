"""Section on networks: accuracy compared with baselines, amount of training, and figures."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape

from spn_data.report.data import ReportData
from spn_data.report.fix_facts import FixFigures
from spn_data.report.run_facts import MethodErrors, NetworkFacts, RunFacts
from spn_data.report.run_verdict import SHORT_IMAGES

_ROLES = {"test": "test frames", "validation": "validation frames", "train": "training images"}
_ORDER = tuple(_ROLES)
_FIX_HEADER = (
    *("flight", "from", "usable", "median", "misleading", "NEES / 6", "within level", "outage"),
)
_NOTHING = "&ndash;"


def networks(data: ReportData) -> str:
    """Return tables with all networks evaluated on the same dataset, then the figures of each run."""
    if not data.runs and not data.broken_runs:
        return ""
    parts = ['<section id="networks"><h2>Networks</h2>']
    parts += [f'<p class="note warn">{escape(text)}</p>' for text in data.broken_runs]
    single = [run for run in data.runs if len(run.networks) == 1]
    # Evaluations on other datasets get tables of their own.
    for dataset in dict.fromkeys(
        run.dataset for run in sorted(single, key=lambda r: not r.is_current)
    ):
        runs = [run for run in single if run.dataset == dataset]
        if not runs[0].is_current:
            parts.append(
                '<p class="note warn">Evaluated on an earlier dataset than the current one: '
                f"{escape(', '.join(run.name for run in runs))}.</p>"
            )
        parts.append(_trained(runs))
        parts += _tables(runs)
        parts += [_fixes(run) for run in runs if not run.is_outdated]
    for run in data.runs:
        if run.is_outdated:
            parts.append(
                f'<p class="note warn">{escape(run.name)}: trained further since its evaluation; '
                "run spn-model evaluate again.</p>"
            )
        else:
            parts.append(_figures(run, opened=run is data.runs[0]))
    return "".join(parts) + "</section>"


def _trained(runs: Iterable[RunFacts]) -> str:
    """Describe each network and its training; note which trainings were short."""
    rows, short = [], []
    for run in runs:
        for name, network in run.networks.items():
            rows.append((escape(name), *_network_cells(network)))
            if network.images is not None and network.images < SHORT_IMAGES:
                short.append(f"{name} ({network.images:,} images)")
    header = (
        *("network", "kind", "parameters", "size", "training time", "best after", "images seen"),
        "time per pose",
    )
    note = (
        f'<p class="note warn">Short training: {escape(", ".join(short))}. Results after longer training '
        "may differ.</p>"
        if short
        else ""
    )
    return _table(header, rows, "trained") + note


def _network_cells(network: NetworkFacts) -> tuple[str, ...]:
    def cell(value: float | None, spec: str, unit: str) -> str:
        return _NOTHING if value is None else f"{value:{spec}}{unit}"

    size = None if network.size_bytes is None else network.size_bytes / 1e6
    return (
        escape(network.kind),
        cell(network.parameters, ",", ""),
        cell(size, ".1f", " MB"),
        cell(network.minutes, ".1f", " min"),
        cell(network.kept_minutes, ".1f", " min"),
        cell(network.images, ",", ""),
        cell(network.ms_an_image, ".1f", " ms"),
    )


def _tables(runs: list[RunFacts]) -> list[str]:
    """Return one table per group: networks first, then baselines, then the results of the paper."""
    names = {name: runs[0].groups[name][0] for name in runs[0].groups}
    order = sorted(names, key=lambda n: (_ORDER.index(names[n]) if names[n] in _ORDER else 9, n))
    return [_group(name, names[name], runs) for name in order]


def _group(name: str, role: str, runs: list[RunFacts]) -> str:
    of_networks: dict[str, MethodErrors] = {}
    baselines: dict[str, MethodErrors] = {}
    for run in runs:
        for method, errors in run.groups.get(name, ("", {}))[1].items():
            is_network = any(method == n or method.startswith(f"{n}, ") for n in run.networks)
            (of_networks if is_network else baselines).setdefault(method, errors)
    first = next(iter({**of_networks, **baselines}.values()), None)
    if first is None:
        return ""
    unit = "m" if runs[0].units == "m" else "units"
    better = next((run.retrieval[name] for run in runs if name in run.retrieval), "")
    ordered = {**of_networks, **{m: baselines[m] for m in sorted(baselines, key=_rank)}}
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
        "* In another courtyard with other cameras; the paper does not state whether means or medians. "
        if published
        else ""
    )
    return (
        f"<h3>{escape(name)}: {first.frames:,} {escape(_ROLES.get(role, role))}</h3>"
        f"{_table(header, rows, 'errors')}"
        f'<p class="note">{note}Estimates are not aligned to the labels. {_axis(first)}'
        "Covariance: median NEES relative to its expected median; 1 is ideal.</p>"
    )


def _fixes(run: RunFacts) -> str:
    """Return the fixes of the bundle of a run; what they mean for a flight is in the verdict."""
    if not run.fixes.rows:
        reason = run.fixes.reason
        return (
            f'<p class="note warn">{escape(run.name)}: its fixes were not measured '
            f"({escape(reason)}).</p>"
            if reason
            else ""
        )
    rows = [
        (
            escape(one.flight),
            escape(one.method),
            f"{one.usable:,} of {one.images:,}",
            _fix_error(one),
            f"{one.misleading:,} (&le; {100 * one.misleading_at_most:.1f} %)"
            if one.compared
            else _NOTHING,
            _NOTHING if one.nees is None else f"{one.nees:.2f}",
            _NOTHING if one.protected is None else f"{one.protected:.1%}",
            _NOTHING if one.longest_outage_s is None else f"{one.longest_outage_s:.1f} s",
        )
        for one in run.fixes.rows
    ]
    return (
        f"<h3>{escape(run.name)}: fixes of its bundle</h3>"
        + _table(_FIX_HEADER, rows, "fixes")
        + '<p class="note">Coarse: the network alone. Search: fixes of single images. Track: of the images '
        "one after the other. Misleading: published as usable and off by more than 0.5 m, 2&deg; or its "
        "protection level; in brackets the upper bound of its share, with 95 % confidence."
        + "".join(f" {escape(text)}" for text in run.fixes.attitudes)
        + "</p>"
    )


def _fix_error(one: FixFigures) -> str:
    if one.error_m is None or one.error_deg is None:
        return _NOTHING
    position = f"{one.error_m:.2f} m" if one.error_m >= 1 else f"{100 * one.error_m:.1f} cm"
    return f"{position}, {one.error_deg:.2f}&deg;"


def _axis(errors: MethodErrors) -> str:
    if not errors.signed:
        return ""
    name = errors.signed[-1][0]
    below = " (negative: too low)" if name == "up" else ""
    return f"{escape(name)}: median signed error, estimated minus true{below}. "


def _rank(method: str) -> tuple[int, str]:
    """Return a sort key from the least informed baseline to the most informed one."""
    kinds = ("mean", "retrieval", "nearest")
    return next((k for k, kind in enumerate(kinds) if method.startswith(kind)), 9), method


def _cells(errors: MethodErrors, first: MethodErrors, unit: str) -> list[str]:
    """Format the errors in the columns of `first`."""
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
    """Embed the figures as images: a browser neither runs scripts of an image nor fetches anything for it."""
    if not run.figures and not run.left_out:
        return ""
    shown = "".join(
        f'<figure><img alt="{escape(figure.caption, quote=True)}" width="{figure.width_px}" '
        f'src="data:image/svg+xml;base64,{base64.b64encode(figure.svg).decode("ascii")}"></figure>'
        for figure in run.figures
    )
    left_out = (
        f"{run.left_out} figures are omitted: too large or not readable as SVG. "
        if run.left_out
        else ""
    )
    text = left_out + " ".join(run.notes)
    return (
        f"<details{' open' if opened else ''}><summary>Figures of <b>{escape(run.name)}</b></summary>"
        f'<p class="note">{escape(text)}</p>{shown}</details>'
    )


def _table(header: tuple[str, ...], rows: Iterable[Iterable[str]], kind: str) -> str:
    """Format a table; cells are HTML already, and each row has as many as the header."""
    cells = [tuple(row) for row in rows]
    if any(len(row) != len(header) for row in cells):
        raise ValueError(f"a row of table {kind} does not match its header {header}")
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in cells)
    return (
        f'<div class="wide"><table class="{kind}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
