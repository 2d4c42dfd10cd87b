"""What `spn-model availability` said of planned waypoints, for the report: read as untrusted files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from spn_data.area.area import Area
from spn_data.area.names import BUNDLE, BUNDLE_FACTS, EXPECTED, RUNS
from spn_data.errors import FormatError
from spn_data.inputs.network_runs import bundle_facts
from spn_data.report.expected import ExpectedPlan
from spn_data.storage.json_files import read_json, reporting_damage, text_of

_MAX_RUNS, _MAX_ROWS, _MAX_TEXT, _MAX_COUNT = 50, 200, 300, 10**9


def read_expected_plans(area: Area) -> tuple[tuple[ExpectedPlan, ...], tuple[str, ...]]:
    """Read what is expected of planned waypoints, by run.

    Parameters
    ----------
    area : Area

    Returns
    -------
    plans : tuple of ExpectedPlan
    broken : tuple of str
        Why others cannot be shown.
    """
    found: list[ExpectedPlan] = []
    broken: list[str] = []
    for name in area.sequences(RUNS)[:_MAX_RUNS]:
        path = area.root / RUNS / name / EXPECTED
        if not path.is_file():
            continue
        try:
            found.append(_read(path, name))
        except FormatError as error:
            broken.append(f"{error}; run spn-model availability again")
    return tuple(found), tuple(broken)


def _read(path: Path, run: str) -> ExpectedPlan:
    table = read_json(path)
    with reporting_damage(path):
        counts, judged_by = table["counts"], table["bundle"]
        present = bundle_facts(path.parent / BUNDLE / BUNDLE_FACTS)
        return ExpectedPlan(
            run=run,
            plan=_text(table["plan"]),
            yes=_count(counts["yes"]),
            perhaps=_count(counts["perhaps"]),
            no=_count(counts["no"]),
            lacking=tuple(
                (
                    _text(one["name"]),
                    _text(one["expected"]),
                    _count(one["landmarks"]),
                    _text(one["reason"]),
                )
                for one in table["lacking"][:_MAX_ROWS]
            ),
            is_current=all(present.get(p) == judged_by[p] for p in ("network", "landmarks")),
        )


def _text(value: Any) -> str:
    return text_of(value, _MAX_TEXT)


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _MAX_COUNT:
        raise ValueError(f"{value!r} is no count")
    return value
