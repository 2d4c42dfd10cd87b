"""Fixes to be expected with the bundle of a run, at planned poses and on evaluation flights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from spn_data.coverage.sequence_table import Queries
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.inputs.evaluation_flights import EvaluationFlight
from spn_data.storage.files import read_csv, write_csv
from spn_data.storage.json_files import write_json
from spn_data.work.timing import Progress
from spn_model.evaluation.availability import Expectation, ExpectedFix, PlannedViews
from spn_model.evaluation.fix_files import FIX_COLUMNS, number_cell
from spn_model.evaluation.fixes import SEARCH, chosen_rows
from spn_model.examples.training_set import TrainingSet
from spn_model.onboard.bundle import FLOAT32, read_bundle
from spn_model.runs.run_files import RunFiles
from spn_model.runs.run_fixes import flown_bundle

_KEPT = 200  # waypoints without a fix that are kept for the report


def expect_fixes(
    run: RunFiles,
    dataset: Path,
    map_hash: str,
    queries: Sequence[Queries],
    progress: Progress,
) -> list[list[ExpectedFix]]:
    """Return whether a fix is to be expected at each pose.

    Parameters
    ----------
    run : RunFiles
    dataset : Path
        Data set of the area, with the training images.
    map_hash : str
        Hash of the map of the area.
    queries : sequence of Queries
        Poses with their cameras; those without a pose are left out.
    progress : Progress
        Receives the step, poses done, and poses in total.

    Returns
    -------
    list of list of ExpectedFix
        For each of `queries`.

    Raises
    ------
    InputError
        If there is no bundle, it has no landmarks, or is of another network or map; if the data set holds no
        training images with map points.
    FormatError
        If bundle or data set are damaged.
    """
    bundle = flown_bundle(run, map_hash)
    wanted = [[int(row) for row in each.known.nonzero()[0]] for each in queries]
    total, done = sum(len(rows) for rows in wanted), 0
    with Dataset(dataset) as data:
        groups = [group for group in data.of_role(Role.TRAIN) if len(group)]
        if not groups:
            raise InputError("has no training images, from which views are rendered", path=dataset)
        progress("training images", 0, 1)
        views = PlannedViews(TrainingSet(*groups, up_is_known=data.info.up_is_known), bundle.folder)
        progress("training images", 1, 1)
        found = []
        for each, rows in zip(queries, wanted, strict=True):
            part = []
            for row in rows:
                camera = each.cameras[row]
                part.append(views.expect(str(each.names[row]), each.poses[row : row + 1], camera))
                done += 1
                progress("views", done, total)
            found.append(part)
    return found


def searched_frames(flight: EvaluationFlight) -> Queries:
    """Return the poses of the frames of an evaluation flight that an evaluation searches for."""
    labels = flight.labels.select(chosen_rows(flight))
    return Queries(labels.names, labels.poses, [flight.camera] * len(labels), labels.reason)


def write_expected(path: Path, expected: Sequence[ExpectedFix]) -> None:
    """Write a CSV file with a row for each pose; empty cells are unknown. Raises StageError if it cannot."""
    write_csv(
        path,
        {
            "name": [one.name for one in expected],
            "expected": [one.expectation.value for one in expected],
            "reason": [one.reason for one in expected],
            "landmarks": [str(one.landmarks) for one in expected],
            "spread": [f"{one.spread:.3f}" for one in expected],
            "shown": [f"{one.shown:.3f}" for one in expected],
            "error": [number_cell(one.error_m) for one in expected],
            "protection_horizontal": [number_cell(one.protection_m[0]) for one in expected],
            "protection_vertical": [number_cell(one.protection_m[1]) for one in expected],
        },
    )


def keep_plan(run: RunFiles, plan: str, expected: Sequence[ExpectedFix]) -> None:
    """Write what is expected of a plan into the folder of a run, for the report; the last plan counts.

    Raises StageError if it cannot be written.
    """
    bundle = read_bundle(run.bundle)
    assert bundle.landmarks is not None  # flown_bundle
    said = Counter(one.expectation for one in expected)
    lacking = [one for one in expected if one.expectation is not Expectation.YES]
    write_json(
        run.expected,
        {
            "version": 1,
            "plan": plan,
            "bundle": {
                "network": bundle.graphs[FLOAT32].sha256,
                "landmarks": bundle.landmarks.sha256,
            },
            "counts": {one.value: said[one] for one in Expectation},
            "lacking": [
                {
                    "name": one.name,
                    "expected": one.expectation.value,
                    "landmarks": one.landmarks,
                    "reason": one.reason,
                }
                for one in lacking[:_KEPT]
            ],
        },
    )


def measured_usable(run: RunFiles) -> dict[str, bool]:
    """Return which frames had a usable fix when they were searched for in the last evaluation of a run.

    Raises InputError if fixes were not evaluated, or fixes.csv is damaged.
    """
    if not run.fixes.is_file():
        raise InputError(
            f"does not exist; run spn-model evaluate --run {run.name} first", path=run.fixes
        )
    usable = {}
    for line, row in read_csv(run.fixes, FIX_COLUMNS):
        if row["usable"] not in ("0", "1"):
            raise InputError(
                f"usable is {row['usable'][:40]!r}, not 0 or 1", path=run.fixes, line=line
            )
        if row["method"] == SEARCH:
            usable[row["name"]] = row["usable"] == "1"
    return usable
