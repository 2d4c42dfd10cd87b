"""The command `spn-data audit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spn_cli import console, options, output

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
    with area.locked(), console.working("Checking the split"):
        findings = check(area)
    show_findings(findings, shown=None if everything else _SHOWN)
    fail_if_failed(findings)


def show_findings(findings: tuple[AuditFinding, ...], *, shown: int | None = _SHOWN) -> None:
    """Print what the checks found, with its evidence, and how many passed."""
    from spn_data.split.audit import AuditVerdict, has_failed

    output.figures(audit=findings)
    all_shown = output.current().verbose
    rows = []
    for finding in findings:
        if finding.verdict is AuditVerdict.PASS and not all_shown:
            continue
        rows.append((finding.check, finding.verdict.value, finding.text))
        rows += [(finding.check, "", f"- {line}") for line in finding.evidence[:shown]]
        if shown is not None and len(finding.evidence) > shown:
            more = len(finding.evidence) - shown
            rows.append((finding.check, "", f"- and {more} more (spn-data audit --all)"))
    if rows:
        console.table("Audit", rows, ("check", "", "found"))
    passed = sum(finding.verdict is AuditVerdict.PASS for finding in findings)
    details = "" if all_shown else " (-v lists them)"
    ended = "Audit failed" if has_failed(findings) else "Audit passed"
    console.say(f"{ended}: {passed} of {len(findings)} checks passed{details}.")


def fail_if_failed(findings: tuple[AuditFinding, ...]) -> None:
    """Raise ClickException (exit code 1) if a check failed."""
    from spn_data.split.audit import AuditVerdict, has_failed

    if has_failed(findings):
        failed = [f.check for f in findings if f.verdict is AuditVerdict.FAIL]
        raise click.ClickException(f"the audit failed: {', '.join(failed)}")
