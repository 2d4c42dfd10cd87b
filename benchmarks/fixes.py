"""Measure the fixes of a bundle on frames of known pose, on foreign frames, and on spoilt frames.

    PYTHONPATH=. python benchmarks/fixes.py AREA BUNDLE [--foreign FOLDER ...] [--spoilt 100]

Truth are the labels of the evaluation sequences of the area. Each frame is searched for alone. A fix is
misleading if it is off by more than 0.5 m or 2 degrees, or by more than its protection level; a fix of a
foreign or spoilt frame is counted as misleading by the same rule, and always if the frame is foreign.
Protection levels, NEES and errors are those of usable fixes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import spn_data
from spn_data.area.area import Area
from spn_data.geometry.camera import Camera
from spn_data.inputs.frame_images import image_path
from spn_data.labels.labels import Labels
from spn_model.evaluation.fixes import fix_error
from spn_model.integrity.fix import Fix
from spn_model.onboard.pilot import Pilot, PilotOptions


def spoilt(image: np.ndarray, camera: Camera) -> Iterator[tuple[str, np.ndarray, Camera]]:
    """Yield the image spoilt in ways that happen, with the camera that is stated for it."""
    height, width = image.shape[:2]
    gray = np.full_like(image, 128)
    yield "black", np.zeros_like(image), camera
    yield "fog", cv2.addWeighted(image, 0.08, gray, 0.92, 0), camera
    yield "motion blur", cv2.blur(image, (width // 24, 3)), camera
    covered = image.copy()
    covered[:, : width // 2] = 20
    yield "half covered", covered, camera
    yield "overexposed", cv2.convertScaleAbs(image, alpha=3.0, beta=80), camera
    yield "underexposed", cv2.convertScaleAbs(image, alpha=0.08), camera
    turned = cv2.resize(cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE), (width, height))
    yield "turned by 90 degrees", turned, camera
    params = camera.params.copy()
    focal = 2 if camera.focal_px[0] != params[0] or "fx" in camera.model else 1
    params[:focal] *= 1.05
    yield "focal length 5 % wrong", image, replace(camera, params=params)
    changed = image.copy()
    third = changed[:, width // 3 : 2 * width // 3]
    third[:] = third[:, ::-1].copy()
    yield "a third changed", changed, camera


def errors(fix: Fix, labels: Labels, row: int) -> tuple[float, float, float, bool]:
    """Return position and rotation error, NEES / 6, and whether the fix is misleading."""
    found = fix_error(fix, labels.poses[row : row + 1])
    return found.error_m, found.error_deg, found.nees, found.is_misleading


def main() -> None:
    """Print a row for each set of frames."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("area", type=Path)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--foreign", type=Path, nargs="*", default=[], help="folders of images")
    parser.add_argument("--spoilt", type=int, default=0, help="frames to spoil, of each sequence")
    parser.add_argument("--no-network", action="store_true")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    area, reader = Area(given.area), spn_data.open_area(given.area)
    options = PilotOptions(sequence=False, network=not given.no_network)
    print(f"{'frames':34} usable of      median   deg   max m  NEES/6  PL>=err  misleading   ms")
    for name in [n for n in reader.sequences if "mapping" not in n]:
        labels, camera = reader.labels(name), reader.map.cameras[name]
        rows = np.flatnonzero(labels.registered & ~labels.tracked)
        pilot = Pilot(given.bundle, camera, options)
        results, times, bad = [], [], 0
        for row in rows.tolist():
            image = cv2.imread(str(image_path(area, str(labels.names[row]), name)))
            fix = pilot.fix(image, 1)
            times.append(fix.processing_s)
            if isinstance(fix, Fix):
                results.append(errors(fix, labels, row))
                bad += results[-1][3]
        found = np.array(results, dtype=float).reshape(-1, 4)
        print(
            f"{name:34} {len(found):5} {len(rows):5} {np.median(found[:, 0]):8.4f} "
            f"{np.median(found[:, 1]):6.3f} {found[:, 0].max(initial=0):7.3f} {found[:, 2].mean():7.2f} "
            f"{100 * (1 - bad / max(len(found), 1)):7.1f} % {bad:8}  {1e3 * np.median(times):8.0f}",
            flush=True,
        )
        kinds: dict[str, list[int]] = {}
        for row in rows[:: max(1, len(rows) // max(given.spoilt, 1))][: given.spoilt].tolist():
            image = cv2.imread(str(image_path(area, str(labels.names[row]), name)))
            for kind, changed, stated in spoilt(image, camera):
                pilot.camera = stated
                fix = pilot.fix(changed, 1)
                count = kinds.setdefault(kind, [0, 0, 0])
                count[0] += 1
                if isinstance(fix, Fix):
                    count[1] += 1
                    away, turn, _, wrong = errors(fix, labels, row)
                    count[2] += wrong
                    if wrong:
                        print(
                            f"  {labels.names[row]}, {kind}: {away:.3f} m, {turn:.2f} deg, protection "
                            f"{fix.horizontal_protection_m:.3f} m, {fix.vertical_protection_m:.3f} m"
                        )
        for kind, (of, usable, wrong) in kinds.items():
            print(f"{name + ', ' + kind:34} {usable:5} {of:5} {'':41} {wrong:8}", flush=True)
    for folder in given.foreign:
        of = usable = 0
        for path in sorted(folder.rglob("*.jpg")):
            of += 1
            usable += isinstance(pilot.fix(cv2.imread(str(path)), 1), Fix)
        print(f"{'foreign: ' + folder.name:34} {usable:5} {of:5} {'':41} {usable:8}", flush=True)


if __name__ == "__main__":
    main()
