"""Sections of the page in plain HTML; all text from the area is escaped here."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.report.area_verdict import DATA, AreaVerdict
from spn_data.report.data import FAILED, STRATA, FrameTable, PlaceToFly, ReportData
from spn_data.report.figures import format_value
from spn_data.report.next_step import command_for
from spn_data.report.residual_map import residual_map
from spn_data.report.verdict import Level, VerdictReason
from spn_data.split import audit
from spn_data.split.groups import LEFT_OUT
from spn_data.split.split_file import limitations
from spn_data.storage.stage_record import StageRecord

_REASONS_SHOWN = 6  # per sequence
_PLACES_SHOWN = 8  # to fly again, before the rest is collapsed
_EVIDENCE_SHOWN = 50  # lines per check
_MARKS = {
    Level.GOOD: ("&#10003;", "good"),
    Level.CAUTION: ("!", "caution"),
    Level.STOP: ("&#10005;", "stop"),
    Level.UNKNOWN: ("?", "not measured"),
}


def heading(data: ReportData) -> str:
    """Return the name and path of the area and the time of the report."""
    unit = "" if data.units == "m" else ' <span class="unit">units: model</span>'
    return (
        f"<h1>{escape(data.title)}{unit}</h1>"
        f'<p class="note">{escape(data.path)} &middot; last change {escape(data.made)}, by spn-data '
        f"{escape(data.version)}</p>"
    )


def verdict_box(judged: AreaVerdict, area: Path) -> str:
    """Return the verdict in its three parts, the next step, and the findings on the data."""
    step = judged.next
    parts = "".join(_part(name, found, area, step) for name, found in judged.parts())
    next_line = f'<p class="next"><b>Next:</b> {_what_to_do(step, area)}</p>'
    findings = "".join(_finding(f, area, is_next=f is step) for f in judged.data.findings)
    return (
        f'<section id="verdict" class="{judged.data.level}">{parts}{next_line}'
        f"<h3>Findings on the data</h3><ul>{findings}</ul></section>"
    )


def _part(name: str, found: VerdictReason, area: Path, step: VerdictReason) -> str:
    """Return a part of the verdict: a headline for the data, a line for each network."""
    mark, word = _MARKS[found.level]
    do = "" if found is step else _what_to_do(found, area)
    text = f"<b>{name}:</b> {escape(found.text)}{f' <em>{do}</em>' if do else ''}"
    kind = "h2" if name == DATA else "p"
    return (
        f'<{kind} class="part {found.level}"><span class="mark" title="{word}">{mark}</span>'
        f"<span>{text}</span></{kind}>"
    )


def _finding(finding: VerdictReason, area: Path, *, is_next: bool) -> str:
    mark, word = _MARKS[finding.level]
    do = "" if is_next else _what_to_do(finding, area)
    return (
        f'<li class="{finding.level}"><span class="mark" title="{word}">{mark}</span>'
        f"<span>{escape(finding.text)}{f' <em>{do}</em>' if do else ''}</span></li>"
    )


def _what_to_do(finding: VerdictReason, area: Path) -> str:
    command = command_for(finding.command, area)
    code = f"<code>{escape(command)}</code>" if command else ""
    return f"{escape(finding.do)}{': ' if finding.do and code else '.' if finding.do else ''}{code}"


def view(data: ReportData, max_points: int, notes: str) -> str:
    """Return the container of the 3D view, which the script draws, with notes (HTML) below it."""
    thinned = ""
    if data.points is not None and len(data.points) > max_points:
        thinned = f" {max_points:,} of {len(data.points):,} points are shown."
    frame = (
        "Grid in metres; the arrow points north."
        if data.units == "m"
        else "Grid in model units; up is estimated from the cameras, north is unknown."
    )
    return (
        '<section id="map"><h2>Map</h2><div class="view"><canvas id="view" tabindex="0" '
        'aria-label="3D view of the map"></canvas><div id="north" hidden>N</div>'
        '<details id="legend"></details></div><p class="note" id="estimated"></p>'
        f'<p class="note">Drag to rotate, use the right button or two fingers to pan, the wheel (after a '
        f"click) or pinch to zoom; click a camera to see its image. {frame}{thinned}"
        f'<span id="fallback"></span></p>{notes}</section>'
    )


def residuals(data: ReportData) -> str:
    """Return the plan view of GNSS residuals."""
    if data.geo is None:
        return ""
    drawn = residual_map(data.frames)
    if not drawn:
        return ""
    held_out = data.geo.held_out_blocks
    extra = ""
    if held_out.frames:
        extra = (
            f'<p class="note">Held-out fixes ({held_out.folds} blocks of time): '
            f"{format_value(held_out.horizontal_rmse_m, '.2f')} m horizontal, "
            f"{format_value(held_out.vertical_rmse_m, '.2f')} m vertical (RMSE).</p>"
        )
    return f'<section id="residuals"><h2>GNSS residuals in plan view</h2>{drawn}{extra}</section>'


def control(data: ReportData) -> str:
    """Return the table of surveyed points: residuals beside what is stated."""
    if data.geo is None or not data.geo.control:
        return ""
    rows = []
    for point in data.geo.control:
        role = f"{point.role} (left out)" if point.is_outlier else point.role
        metres = [
            f"{format_value(value, '+.3f')} ({format_value(sigma, '.3f')})"
            for value, sigma in zip(point.residual_m, point.sigma_m, strict=True)
        ]
        pixels = format_value(point.reprojection_px, ".2f")
        rows.append((point.name, role, f"{point.marks}", *metres, pixels))
    header = ("point", "role", "marks", "east m", "north m", "up m", "px")
    return (
        '<section id="control"><h2>Ground control</h2>'
        f"{_table(header, rows, 'control')}"
        '<p class="note">Surveyed minus mapped, with the stated standard deviation in brackets. Check points '
        "are not fitted: their residuals are errors of the map.</p></section>"
    )


def timeline(data: ReportData, left_out: dict[str, int]) -> str:
    """Return frames over time, which the script draws, and the reasons of failed frames."""
    frames = data.frames
    if not len(frames):
        return ""
    rows = []
    for name in np.unique(frames.sequences).tolist():
        mine = frames.sequences == name
        reasons = frames.reasons(mine)
        rows += [(name, reason, f"{n:,}") for reason, n in reasons[:_REASONS_SHOWN]]
        if len(reasons) > _REASONS_SHOWN:
            others = sum(n for _, n in reasons[_REASONS_SHOWN:])
            rows.append((name, "other reasons", f"{others:,}"))
    failures = (
        _table(("sequence", "why frames have no pose", "frames"), rows, "failures")
        if rows
        else '<p class="note">All attempted frames have a pose.</p>'
    )
    return (
        '<section id="time"><h2>Frames over time</h2><div id="timeline"></div>'
        f"{_left_out(left_out)}{failures}</section>"
    )


def _left_out(left_out: dict[str, int]) -> str:
    if not left_out:
        return ""
    what = " and ".join(f"{n:,} {kind}" for kind, n in left_out.items())
    return f'<p class="note">To limit the size of this page, {escape(what)} are neither drawn nor listed.</p>'


def coverage(data: ReportData) -> str:
    """Return strata as bars and the places to fly again, for evaluation sequences and planned waypoints."""
    parts = []
    for anchor, title, facts in (
        ("coverage", "Coverage", data.coverage),
        ("planned", "Coverage of planned waypoints", data.plan),
    ):
        if facts is None:
            continue
        bars = "".join(_strata_bar(name, counts) for name, counts in sorted(facts.strata.items()))
        parts.append(
            f'<section id="{anchor}"><h2>{title}</h2>{bars}'
            f'<p class="note">{escape(facts.limits)}</p>{_fly_again(facts.fly_again)}</section>'
        )
    return "".join(parts)


def _fly_again(places: Sequence[PlaceToFly]) -> str:
    """Return a table of places; a long one is collapsed after its first rows."""
    header = (
        *("", "latitude, longitude", "east, north, up (m)", "heading (deg)", "pitch (deg)"),
        "frames helped",
    )
    rows = []
    for k, place in enumerate(places, 1):
        e, n, u = place.east_north_up_m
        latitude, longitude = place.lat_lon_deg
        rows.append(
            (
                str(k),
                f"{latitude:.7f}, {longitude:.7f}",
                f"{e:.1f}, {n:.1f}, {u:.1f}",
                f"{place.heading_deg:.0f}",
                f"{place.pitch_deg:.0f}",
                f"{place.frames:,}",
            )
        )
    if not rows:
        return ""
    first, rest = rows[:_PLACES_SHOWN], rows[_PLACES_SHOWN:]
    more = (
        f"<details><summary>{len(rest):,} more</summary>{_table(header, rest, 'again')}</details>"
        if rest
        else ""
    )
    return f"<h3>Where to fly again</h3>{_table(header, first, 'again')}{more}"


def _strata_bar(name: str, counts: dict[str, int]) -> str:
    total = sum(counts.values())
    if not total:
        return ""
    known = [s for s in STRATA if counts.get(s)]
    others = [s for s in counts if s not in STRATA and counts[s]]
    pieces = "".join(
        f'<span class="{escape(s) if s in STRATA else "none"}" style="flex:{counts[s]}" '
        f'title="{escape(s)}: {counts[s]:,} of {total:,}"></span>'
        for s in known + others
    )
    text = ", ".join(f"{escape(s)} {counts[s] / total:.0%} ({counts[s]:,})" for s in known + others)
    return f'<div class="strata"><b>{escape(name)}</b> {text}<div class="bar">{pieces}</div></div>'


def split(data: ReportData) -> str:
    """Return the groups of the split and the findings of the audit."""
    if data.split is None:
        return ""
    left_out = int((data.split.group == LEFT_OUT).sum())
    rows = [*data.split.counts().items(), *([("left out", left_out)] if left_out else [])]
    parts = [
        '<section id="split"><h2>Split and audit</h2>',
        _table(("group", "frames"), [(group, f"{n:,}") for group, n in rows], "groups"),
    ]
    notes = (*data.split.notes, *limitations(data.split))
    parts += [f'<p class="note">{escape(note)}</p>' for note in notes]
    return "".join(parts) + "".join(_check(check) for check in data.audit or ()) + "</section>"


def _check(check: audit.AuditFinding) -> str:
    """Return one line of the audit with its evidence collapsed."""
    level = {
        audit.AuditVerdict.PASS: Level.GOOD,
        audit.AuditVerdict.NOTICE: Level.CAUTION,
        audit.AuditVerdict.FAIL: Level.STOP,
    }[check.verdict]
    mark, word = _MARKS[level]
    text = f"<b>{escape(check.check)}</b>: {escape(check.text)}"
    if check.evidence:
        more = len(check.evidence) - _EVIDENCE_SHOWN
        lines = [*check.evidence[:_EVIDENCE_SHOWN], *([f"and {more:,} more"] if more > 0 else [])]
        listed = "".join(f"<li>{escape(line)}</li>" for line in lines)
        text = f"<details><summary>{text}</summary><ul>{listed}</ul></details>"
    return (
        f'<div class="rule {level}"><span class="mark" title="{word}">{mark}</span>'
        f"<div>{text}</div></div>"
    )


def table(frames: FrameTable) -> str:
    """Return the container of the table of all frames, which the script fills."""
    failed = int((frames.status == FAILED).sum())
    return (
        f'<section id="frames"><h2>All frames</h2><div id="table" data-frames="{len(frames)}" '
        f'data-failed="{failed}"></div></section>'
    )


def stages(data: ReportData) -> str:
    """Return options, versions and inputs of each stage, collapsed."""
    parts = ['<section id="stages"><h2>How it was made</h2>']
    for stage in data.stages:
        record = stage.record
        state = f'<span class="warn">stale: {escape(stage.stale)}</span>' if stage.stale else ""
        parts.append(
            f"<details><summary><b>{escape(record.stage)}</b> {escape(record.finished)} "
            f"{_seconds(record)} {state}</summary>{_record(record)}</details>"
        )
    return "".join(parts) + "</section>"


def _record(record: StageRecord) -> str:
    notes = "".join(f"<li>{escape(note)}</li>" for note in record.notes)
    options = _table(("option", "value"), list(_flat(record.options)), "options")
    versions = ", ".join(f"{escape(k)} {escape(v)}" for k, v in sorted(record.versions.items()))
    steps = ", ".join(f"{escape(name)} {s:.1f} s" for name, s in record.seconds.items())
    inputs = _table(("file", "fingerprint"), sorted(record.inputs.items()), "inputs")
    return (
        (f"<ul>{notes}</ul>" if notes else "")
        + f'<p class="note">{versions}<br>{steps}</p>'
        + options
        + (
            f"<details><summary>{len(record.inputs):,} source files</summary>{inputs}</details>"
            if record.inputs
            else ""
        )
    )


def _flat(value: dict[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    for name, item in sorted(value.items()):
        if isinstance(item, dict) and item:
            yield from _flat(item, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", json.dumps(item)


def _seconds(record: StageRecord) -> str:
    total = sum(record.seconds.values())
    return f"({total:.0f} s)" if total < 90 else f"({total / 60:.0f} min)"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], kind: str) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows
    )
    return (
        f'<div class="wide"><table class="{kind}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
