"""Compare the poses of the common frames of two georegistered areas.

    python benchmarks/agreement.py AREA OTHER_AREA [--json OUT]

Frames are paired by file name. Positions are compared in the world, as georegistered, and after alignment by
the best similarity, which leaves the difference between the two reconstructions.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from spn_data.area.area import Area
from spn_data.area.names import GEO, GEO_FIT
from spn_data.colmap.model import Scene, read_scene
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.georegistration.result import GeoFit
from spn_data.storage.json_files import read_json


def compare(area: Area, other: Area) -> dict[str, Any]:
    """Return differences in metres and degrees over the common frames."""
    scenes = [read_scene(a.folder(GEO)) for a in (area, other)]
    fits = [GeoFit.from_json(read_json(a.folder(GEO) / GEO_FIT)) for a in (area, other)]
    rows = [_by_stem(scene) for scene in scenes]
    common = sorted(set(rows[0]) & set(rows[1]))
    first, second = (
        scene.poses[np.array([row[stem] for stem in common])]
        for scene, row in zip(scenes, rows, strict=True)
    )
    # The axes of two origins a few hundred metres apart differ by less than 0.01 degrees.
    moved = fits[0].origin.enu_from_wgs84(fits[1].origin.wgs84_from_enu(second.centers))
    same_zero = _same_zero(fits[0].origin, fits[1].origin)
    difference = moved - first.centers
    _, turned_deg = pose_errors(Poses(moved, second.quats_wxyz), first)
    aligned = Similarity.fit(second.centers, first.centers).apply_to_poses(second)
    aligned_m, aligned_deg = pose_errors(aligned, first)
    horizontal = np.hypot(difference[:, 0], difference[:, 1])
    return {
        "frames": len(common),
        "of": [len(row) for row in rows],
        "horizontal_median_m": float(np.median(horizontal)),
        "horizontal_p95_m": float(np.quantile(horizontal, 0.95)),
        "vertical_median_m": float(np.median(np.abs(difference[:, 2]))),
        "vertical_p95_m": float(np.quantile(np.abs(difference[:, 2]), 0.95)),
        "heights_have_the_same_zero": same_zero,
        "rotation_median_deg": float(np.median(turned_deg)),
        "rotation_p95_deg": float(np.quantile(turned_deg, 0.95)),
        "aligned_position_median_m": float(np.median(aligned_m)),
        "aligned_position_p95_m": float(np.quantile(aligned_m, 0.95)),
        "aligned_rotation_median_deg": float(np.median(aligned_deg)),
        "stated_horizontal_m": [fit.uncertainty.horizontal_m for fit in fits],
        "stated_vertical_m": [fit.uncertainty.vertical_m for fit in fits],
    }


def _by_stem(scene: Scene) -> dict[str, int]:
    return {Path(name).stem: k for k, name in enumerate(scene.names)}


def _same_zero(a: GeoOrigin, b: GeoOrigin) -> bool:
    """Return whether heights are comparable; two take-off points may have different heights."""
    return a.height_reference == b.height_reference != "takeoff"


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("area", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    figures = compare(Area(arguments.area), Area(arguments.other))
    console = Console(highlight=False)
    for name, value in figures.items():
        shown = f"{value:.3f}" if isinstance(value, float) else str(value)
        console.print(f"{name:<32}{shown}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
