"""Fixes to be expected along planned waypoints, as the report shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True, kw_only=True)
class ExpectedPlan:
    """What `spn-model availability` said of a plan with the bundle of a run.

    Attributes
    ----------
    run, plan : str
        Name of the run, and of the file with the waypoints.
    yes, perhaps, no : int
        Waypoints by what is expected there.
    lacking : tuple of (str, str, int, str)
        Name, expectation, landmarks in view and reason of waypoints that are not *yes*; the first of them.
    is_current : bool
        Whether it was judged by the present bundle.
    """

    run: str
    plan: str
    yes: int
    perhaps: int
    no: int
    lacking: tuple[tuple[str, str, int, str], ...]
    is_current: bool


def expected_plans(plans: Sequence[ExpectedPlan], broken: Sequence[str]) -> str:
    """Return the section on planned waypoints; nothing if there are none."""
    if not plans and not broken:
        return ""
    parts = ['<section id="expected"><h2>Planned waypoints</h2>']
    parts += [f'<p class="note warn">{escape(text)}</p>' for text in broken]
    parts += [_plan(one) for one in plans]
    return "".join(parts) + "</section>"


def _plan(one: ExpectedPlan) -> str:
    total = one.yes + one.perhaps + one.no
    old = (
        ""
        if one.is_current
        else '<p class="note warn">Judged by an earlier bundle; run spn-model availability again.</p>'
    )
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(said)}</td><td>{landmarks:,}</td><td>{escape(reason)}</td></tr>"
        for name, said, landmarks, reason in one.lacking
    )
    table = (
        '<div class="wide"><table class="expected"><thead><tr><th>waypoint</th><th>fix</th><th>landmarks</th>'
        f"<th>why not</th></tr></thead><tbody>{rows}</tbody></table></div>"
        if rows
        else ""
    )
    more = one.perhaps + one.no - len(one.lacking)
    return (
        f"<h3>{escape(one.plan)}, bundle of {escape(one.run)}</h3>{old}"
        f"<p>A fix is to be expected at {one.yes:,} of {total:,} waypoints"
        f"{f', perhaps at {one.perhaps:,} more' if one.perhaps else ''}.</p>{table}"
        + (f'<p class="note">{more:,} more are not shown.</p>' if more > 0 else "")
        + '<p class="note">Views were rendered there from the training images and searched by the bundle. '
        "Perhaps: none in the rendered view, but many landmarks. Not known: light, seasons, what moved or "
        "moves, and motion blur.</p>"
    )
