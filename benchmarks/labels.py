"""Compare all labels of an area with the exact ground truth of its flights.

    python benchmarks/labels.py AREA FLIGHTS [--json OUT]

FLIGHTS is the output of `spn-data simulate`, including evaluation flights, or `../shared/data/courtyard-b`.
The best similarity of the map to the truth, over its mapping frames, is removed first, so that only
registration is evaluated. A covariance is correct if the NEES e^T C^-1 e is chi-squared with 6 degrees of
freedom: median 5.35 (calibration 1), 0.1 % above 22.5 (beyond). Frames of one sequence share the error of the
map, so that the calibration of one sequence is hardly more than a single draw.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from truth import error_figures, read_arguments, true_flight, true_poses

from spn_data.area.area import Area
from spn_data.geometry.pose import Similarity, pose_errors
from spn_data.geometry.rotations import rotation_vectors
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.labels.labels import Labels

CHI2_MEDIAN, CHI2_FAR = 5.348, 22.5
WRONG_M, WRONG_DEG = 0.5, 2.0


def compare(area: Area, flights: Path) -> dict[str, Any]:
    """Return the figures of each kind of label, lengths in metres."""
    labelled = read_labelled_area(area)
    mapping = labelled.mapping.select(labelled.mapping.registered)
    world_from_map = Similarity.fit(mapping.poses.centers, true_poses(mapping, flights).centers)
    figures = {"mapping": figures_of(mapping, world_from_map, flights)}
    for name in np.unique(labelled.tracked.sequences).tolist():
        mine = labelled.tracked.select(labelled.tracked.sequences == name)
        figures[f"{name} (between)"] = figures_of(mine, world_from_map, flights)
    for name, labels in labelled.evaluation.items():
        figures[name] = figures_of(labels.select(~labels.tracked), world_from_map, flights)
        if labels.tracked.any():
            figures[f"{name} (between)"] = figures_of(
                labels.select(labels.tracked), world_from_map, flights
            )
            figures[f"{name} (all frames)"] = figures_of(labels, world_from_map, flights)
        figures[name]["focal_error"] = focal_error(labelled, name, flights)
    return figures


def figures_of(labels: Labels, world_from_map: Similarity, flights: Path) -> dict[str, Any]:
    """Return the errors and the calibration of labels."""
    registered = labels.select(labels.registered)
    figures: dict[str, Any] = {"frames": len(labels), "registered": len(registered)}
    if not len(registered):
        return figures
    true = true_poses(registered, flights)
    found = registered.transformed(world_from_map)
    error_m, error_deg = pose_errors(found.poses, true)
    turned = rotation_vectors(true.rotations @ np.transpose(found.poses.rotations, (0, 2, 1)))
    error = np.concatenate([true.centers - found.poses.centers, turned], axis=1)
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    return figures | {
        **error_figures(found.poses, true),
        "rotation_max_deg": float(error_deg.max()),
        "wrong": int(((error_m > WRONG_M) | (error_deg > WRONG_DEG)).sum()),
        "calibration": float(np.median(distance) / CHI2_MEDIAN),
        "beyond": float((distance > CHI2_FAR).mean()),
    }


def focal_error(labelled: LabelledArea, name: str, flights: Path) -> float:
    """Return the relative error of a sequence's focal length."""
    return labelled.cameras[name].focal_px[0] / true_flight(flights, name)[1] - 1


def main() -> None:
    """Run the benchmark."""
    arguments = read_arguments(__doc__)
    figures = compare(Area(arguments.area), arguments.flights)
    table = Table(title="Labels against exact truth", title_justify="left", box=None)
    for column in (
        *("", "labels", "median", "p95", "max", "median", "p95", "max", "wrong"),
        *("calibration", "beyond", "focal"),
    ):
        table.add_column(column, justify="right" if column else "left")
    for name, f in figures.items():
        share = f"{f['registered']}/{f['frames']}"
        if not f["registered"]:
            table.add_row(name, share)
            continue
        quantiles = ("median", "p95", "max")
        table.add_row(
            name,
            f"{share} ({f['registered'] / f['frames']:.1%})",
            *(f"{f[f'position_{q}_m'] * 100:.1f} cm" for q in quantiles),
            *(f"{f[f'rotation_{q}_deg']:.3f} deg" for q in quantiles),
            str(f["wrong"]),
            f"{f['calibration']:.2f}",
            f"{f['beyond']:.1%}",
            f"{f['focal_error']:+.3%}" if "focal_error" in f else "",
        )
    Console(width=160).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
