"""Measure the fixes of a bundle on frames of known pose, on foreign frames, and on spoilt frames.

    PYTHONPATH=. python benchmarks/fixes.py AREA BUNDLE [--foreign FOLDER ...] [--spoilt 100]
        [--attitude-sigma 1]

With --attitude-sigma, each frame is localized a second time, with a known vertical: that of its label, with
simulated (sim.) normal noise of this standard deviation along each of two axes. Medians of the network's own
poses are over all frames; one without a pose counts as infinite.

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
from spn_data.geometry.pose import pose_errors
from spn_data.inputs.frame_images import image_path
from spn_data.labels.labels import Labels
from spn_model.evaluation.fixes import fix_error
from spn_model.evaluation.flight_attitude import noisy_vertical
from spn_model.integrity.fix import Fix
from spn_model.onboard.flight_report import StepTimes
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


def coarse(
    pilot: Pilot, area: Area, name: str, labels: Labels, rows: np.ndarray, sigma_deg: float | None
) -> str:
    """Return how many frames the network alone locates, and its median errors over all frames."""
    found, rng = np.full((len(rows), 2), np.inf), np.random.default_rng(0)
    for k, row in enumerate(rows.tolist()):
        image = cv2.imread(str(image_path(area, str(labels.names[row]), name)))
        truth = labels.poses[row : row + 1]
        vertical = None if sigma_deg is None else noisy_vertical(truth.rotations[0], sigma_deg, rng)
        located = pilot.localizer.localize(image, pilot.camera, vertical=vertical)
        if not located.reason:
            found[k] = [float(v[0]) for v in pose_errors(located.poses, truth)]
    near = 100 * np.mean((found[:, 0] < 5) & (found[:, 1] < 10))
    median_m, median_deg = np.median(found, axis=0)
    return (
        f"{np.isfinite(found[:, 0]).sum():5} {len(rows):5} {median_m:8.4f} {median_deg:6.3f}   "
        f"{near:.0f} % within 5 m and 10 deg"
    )


def measured(
    pilot: Pilot, area: Area, name: str, labels: Labels, rows: np.ndarray, sigma_deg: float | None
) -> tuple[np.ndarray, StepTimes]:
    """Return the errors of the fixes of some frames, and the times of the steps."""
    results, steps, rng = [], StepTimes(), np.random.default_rng(0)
    for row in rows.tolist():
        image = cv2.imread(str(image_path(area, str(labels.names[row]), name)))
        vertical = None
        if sigma_deg is not None:
            vertical = noisy_vertical(labels.poses.rotations[row], sigma_deg, rng)
        fix = pilot.fix(image, 1, vertical)
        steps.add(pilot.steps_s, fix.processing_s)
        if isinstance(fix, Fix):
            results.append(errors(fix, labels, row))
    return np.array(results, dtype=float).reshape(-1, 4), steps


def show(name: str, of: int, found: np.ndarray, steps: StepTimes) -> None:
    """Print the row of a set of frames."""
    bad = int(found[:, 3].sum())
    print(
        f"{name:34} {len(found):5} {of:5} {np.median(found[:, 0]):8.4f} "
        f"{np.median(found[:, 1]):6.3f} {found[:, 0].max(initial=0):7.3f} {found[:, 2].mean():7.2f} "
        f"{100 * (1 - bad / max(len(found), 1)):7.1f} % {bad:8}  {1e3 * steps.median_s():8.0f}",
        flush=True,
    )


def main() -> None:
    """Print a row for each set of frames."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("area", type=Path)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--foreign", type=Path, nargs="*", default=[], help="folders of images")
    parser.add_argument("--spoilt", type=int, default=0, help="frames to spoil, of each sequence")
    parser.add_argument("--no-network", action="store_true")
    parser.add_argument(
        "--attitude-sigma", type=float, help="of a simulated known vertical, degrees"
    )
    given = parser.parse_args()
    cv2.setNumThreads(1)
    area, reader = Area(given.area), spn_data.open_area(given.area)
    options = PilotOptions(sequence=False, network=not given.no_network)
    print(f"{'frames':34} usable of      median   deg   max m  NEES/6  PL>=err  misleading   ms")
    tables: list[tuple[str, StepTimes]] = []
    for name in [n for n in reader.sequences if "mapping" not in n]:
        labels, camera = reader.labels(name), reader.map.cameras[name]
        rows = np.flatnonzero(labels.registered & ~labels.tracked)
        pilot = Pilot(given.bundle, camera, options)
        for sigma_deg in (None, given.attitude_sigma) if given.attitude_sigma else (None,):
            label = name if sigma_deg is None else f"{name}, attitude {sigma_deg:g} deg, sim."
            if options.network:
                found = coarse(pilot, area, name, labels, rows, sigma_deg)
                print(f"{f'network: {label}':34} {found}", flush=True)
            found, steps = measured(pilot, area, name, labels, rows, sigma_deg)
            show(label, len(rows), found, steps)
            tables.append((label, steps))
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
    for name, steps in tables:
        print("\n".join(["", f"{name}, each image alone:", *steps.lines()]))


if __name__ == "__main__":
    main()
