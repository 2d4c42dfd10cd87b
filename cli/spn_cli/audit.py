"""The command `spn-data audit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spn_cli import console, options

if TYPE_CHECKING:
    from spn_data.split.audit import AuditFinding

_SHOWN = 5  # lines of evidence per finding


@click.command()
@options.area
@click.option("--all", "everything", is_flag=True, help="Show all evidence.")
def audit(area_folder: Path, everything: bool) -> None:
    """Audit the split: no leakage, no frame in the wrong set, no damaged file.

    Nothing is changed. The exit code is 1 if a check fails.

    \b
    Example:
        spn-data audit --area fields/north
    """
    from spn_data.pipeline.area_audit import audit as check

    area = options.open_area(area_folder)
    with area.locked():
        findings = check(area)
    show_findings(findings, shown=None if everything else _SHOWN)


def show_findings(findings: tuple[AuditFinding, ...], *, shown: int | None = _SHOWN) -> None:
    """Print the findings with their evidence; raise ClickException (exit code 1) if a check failed."""
    from spn_data.split.audit import AuditVerdict, has_failed

    rows = []
    for finding in findings:
        rows.append((finding.check, finding.verdict.value, finding.text))
        rows += [("", "", f"- {line}") for line in finding.evidence[:shown]]
        if shown is not None and len(finding.evidence) > shown:
            more = len(finding.evidence) - shown
            rows.append(("", "", f"- and {more} more (spn-data audit --all)"))
    console.table("Audit", rows, ("check", "", "found"))
    failed = [f.check for f in findings if f.verdict is AuditVerdict.FAIL]
    if has_failed(findings):
        raise click.ClickException(f"the audit failed: {', '.join(failed)}")
    console.out.print("Audit passed.")
