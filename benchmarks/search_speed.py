"""Compare ways to extract features for the search of single images: share, error and CPU time in one process.

    PYTHONPATH=. python benchmarks/search_speed.py AREA BUNDLE [--every 2] [--foreign FOLDER ...]

AREA has evaluation flights with labels, which are the truth here, and BUNDLE landmarks. Each frame is
searched for alone, without the network. A fix is misleading as in `benchmarks/fixes.py`, and always if its
image is of a foreign folder. Times are CPU times of one thread, in ms: median, and 95 % in brackets; compare
them in one table only. The last lines say how the features on board differ from those of OpenCV, and the most
memory that this process has used.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import spn_data
from spn_data.area.area import Area
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.inputs.frame_images import image_path
from spn_data.matching.features import FeatureOptions, Features, extract
from spn_data.matching.putative import unit_descriptors
from spn_model.evaluation.fixes import fix_error
from spn_model.integrity.fix import Fix
from spn_model.landmarks.sift import Sift
from spn_model.onboard.pilot import Pilot, PilotOptions

# Name, whether OpenCV extracts, working width and most features.
WAYS = (
    ("OpenCV, 640 px, 1024", True, 640, 1024),
    ("OpenCV, 640 px, 500", True, 640, 500),
    ("OpenCV, 480 px, 800", True, 480, 800),
    ("OpenCV, 320 px, 1024", True, 320, 1024),
    ("on board, 640 px, 1024", False, 640, 1024),
    ("on board, 640 px, 700", False, 640, 700),
    ("on board, 480 px, 800", False, 480, 800),
)


class OpenCV:
    """OpenCV's extraction in place of that of the pilot."""

    def __init__(self, options: FeatureOptions):
        self.options = options

    def extract(self, gray: np.ndarray) -> Features:
        """Extract the features of a grey image."""
        return extract(gray, None, self.options)


def frames(
    folder: Path, every: int
) -> Iterator[tuple[str, Camera, Callable[[], Iterator[tuple[np.ndarray, Poses]]]]]:
    """Yield name and camera of each evaluation flight, and what reads its images with their true poses."""
    area, reader = Area(folder), spn_data.open_area(folder)
    for name in [n for n in reader.sequences if "mapping" not in n]:
        labels = reader.labels(name)
        rows = np.flatnonzero(labels.registered & ~labels.tracked)[::every].tolist()

        def images(name=name, labels=labels, rows=rows) -> Iterator[tuple[np.ndarray, Poses]]:
            for row in rows:
                image = cv2.imread(str(image_path(area, str(labels.names[row]), name)))
                yield image, labels.poses[row : row + 1]

        yield name, reader.map.cameras[name], images


def show(
    name: str, errors: list[tuple[float, bool]], of: int, wrong: int, spent: np.ndarray
) -> None:
    """Print the row of a way on one set of images."""
    off = np.array([error for error, _ in errors])
    ms = 1e3 * np.sort(spent)
    median = f"{100 * np.median(off):6.2f}" if len(off) else f"{'':6}"
    print(
        f"{name:44} {len(off):4} {of:4} {int((off < 0.05).sum()):7} {median} {wrong:10}  "
        f"{np.median(ms):4.0f} ({np.percentile(ms, 95):.0f})",
        flush=True,
    )


def timed(pilot: Pilot, image: np.ndarray) -> tuple[Fix | None, float]:
    """Return the fix of an image, and its CPU time in seconds."""
    begin = time.process_time()
    fix = pilot.fix(image, 1)
    return (fix if isinstance(fix, Fix) else None), time.process_time() - begin


def differences(a: Features, b: Features) -> tuple[float, float]:
    """Return the share of features that others have within 0.5 px, and the median cosine of descriptors."""
    off = np.linalg.norm(a.keypoints[:, None, :2] - b.keypoints[None, :, :2], axis=2)
    scale = np.abs(np.log2(a.keypoints[:, None, 2] / b.keypoints[None, :, 2]))
    alike = unit_descriptors(a.descriptors) @ unit_descriptors(b.descriptors).T
    alike[(off > 0.5) | (scale > 0.2)] = -1
    best = alike.max(axis=1)
    return float((best > 0).mean()), float(np.median(best[best > 0]))


def main() -> None:
    """Print a row for each way and flight."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("area", type=Path)
    parser.add_argument("bundle", type=Path)
    parser.add_argument(
        "--every", type=int, default=2, help="frames of a flight that are used: every Nth"
    )
    parser.add_argument("--foreign", type=Path, nargs="*", default=[], help="folders of images")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'features, images':44} usable of  <= 5 cm  cm    misleading  CPU ms")
    same = []
    for name, camera, images in frames(given.area, given.every):
        pilot = Pilot(given.bundle, camera, PilotOptions(sequence=False, network=False))
        stated = pilot.landmarks.facts.features
        pilot.fix(next(images())[0], 1)  # memory and the reduced map
        for way, by_opencv, width, most in WAYS:
            options = replace(stated, max_features=most, max_image_size_px=width)
            # Widths of the search, and so its pixels, stay those of the landmarks.
            pilot.extract = (OpenCV if by_opencv else Sift)(options).extract
            errors, spent, of = [], [], 0
            for image, truth in images():
                fix, seconds = timed(pilot, image)
                spent.append(seconds)
                of += 1
                if fix is not None:
                    found = fix_error(fix, truth)
                    errors.append((found.error_m, found.is_misleading))
            show(f"{way}, {name}", errors, of, sum(wrong for _, wrong in errors), np.array(spent))
        ours, theirs = Sift(stated), OpenCV(stated)
        for image, _ in images():
            gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            same.append(differences(theirs.extract(gray), ours.extract(gray)))
    for folder in given.foreign:
        paths = sorted(folder.rglob("*.jpg"))
        for way, by_opencv, width, most in (WAYS[0], WAYS[4]):
            options = replace(stated, max_features=most, max_image_size_px=width)
            pilot.extract = (OpenCV if by_opencv else Sift)(options).extract
            fixes, spent = zip(
                *(timed(pilot, cv2.imread(str(path))) for path in paths), strict=True
            )
            wrong = sum(fix is not None for fix in fixes)
            show(f"{way}, foreign: {folder.name}", [], len(paths), wrong, np.array(spent))
    share, cosine = np.mean(same, axis=0)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(
        f"\n{100 * share:.0f} % of OpenCV's features are found on board, with a cosine of {cosine:.3f}"
    )
    print(f"most memory of this process: {peak_mb:.0f} MB")


if __name__ == "__main__":
    main()
