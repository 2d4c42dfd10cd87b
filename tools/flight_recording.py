"""Draw the fixes of a flight that `spn-model evaluate` measured, as an animation beside the camera's images.

    python tools/flight_recording.py demo/area default medium docs/images/flight.webp

Each image is shown with the map from above: map points in grey, frames of the map in green, the label in blue
with the path so far, and the fix of the bundle in red.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import spn_data
from spn_data.api import AreaReader
from spn_data.area.area import Area
from spn_data.geometry.pose import Poses
from spn_data.inputs.frame_images import frame_images
from spn_data.storage.files import read_csv
from spn_model.evaluation.fix_files import FIX_COLUMNS

SIDE = 270  # height of the image and of the map, pixels
STRIP = 30  # for the text below both
GREY, GREEN, BLUE, RED = (200, 200, 200), (90, 160, 60), (200, 120, 30), (40, 40, 220)  # BGR
WHITE, BLACK = (255, 255, 255), (30, 30, 30)


class Plan:
    """The area from above, north up."""

    def __init__(self, area: AreaReader, flown: np.ndarray):
        mapped = area.labels().poses.centers
        shown = np.concatenate([mapped, flown[np.isfinite(flown[:, 0])]])[:, :2]
        low, high = shown.min(axis=0), shown.max(axis=0)
        self.middle, self.scale = (low + high) / 2, 0.8 * SIDE / float((high - low).max())
        self.drawn = np.full((SIDE, SIDE, 3), 255, np.uint8)
        for places, colour in ((area.map.points.xyz, GREY), (mapped, GREEN)):
            at = self.pixels(places)
            at = at[((at >= 0) & (at < SIDE)).all(axis=1)]
            self.drawn[at[:, 1], at[:, 0]] = colour

    def pixels(self, places: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of places (N, 3)."""
        away = (places[:, :2] - self.middle) * self.scale * [1, -1]
        return np.rint(np.nan_to_num(away, nan=-1e4) + SIDE / 2).astype(int)

    def pose(self, image: np.ndarray, pose: Poses, colour: tuple[int, int, int]) -> None:
        """Draw a camera and where it looks."""
        at = self.pixels(pose.centers)[0]
        ahead = pose.rotations[0, 2, :2]
        tip = np.rint(at + 14 * ahead / max(np.linalg.norm(ahead), 1e-9) * [1, -1]).astype(int)
        cv2.line(image, at.tolist(), tip.tolist(), colour, 2, cv2.LINE_AA)
        cv2.circle(image, at.tolist(), 4, colour, -1, cv2.LINE_AA)


def rows_of(path: Path, flight: str) -> dict[str, dict[str, str]]:
    """Return the rows of fixes.csv of a flight with motion, by frame."""
    rows = (row for _, row in read_csv(path, FIX_COLUMNS))
    return {row["name"]: row for row in rows if (row["flight"], row["method"]) == (flight, "track")}


def said(row: dict[str, str]) -> str:
    """Return what the fix of an image is, or why there is none."""
    if row["usable"] != "1":
        return f"no fix: {row['reason']}"
    level = max(float(row["protection_horizontal"]), float(row["protection_vertical"]))
    return (
        f"{row['source']}: {100 * float(row['error']):.1f} cm, {float(row['error_deg']):.2f} deg off, "
        f"protected to {100 * level:.0f} cm"
    )


def pictures(folder: Path, run: str, flight: str) -> Iterator[np.ndarray]:
    """Yield the pictures of the animation, BGR."""
    area = spn_data.open_area(folder)
    rows, labels = rows_of(area.run_folder(run) / "fixes.csv", flight), area.labels(flight)
    plan = Plan(area, labels.poses.centers)
    path: list[list[int]] = []
    for k, image in frame_images(Area(folder), labels):
        row = rows.get(str(labels.names[k]))
        if row is None:
            continue
        map_image, truth = plan.drawn.copy(), labels.poses[k : k + 1]
        if labels.registered[k]:
            path.append(plan.pixels(truth.centers)[0].tolist())
            cv2.polylines(map_image, [np.array(path)], False, BLUE, 1, cv2.LINE_AA)
            plan.pose(map_image, truth, BLUE)
        if row["usable"] == "1":
            place = np.array([[float(row[name]) for name in "xyz"]])
            quat = np.array([[float(row[f"q{name}"]) for name in "wxyz"]])
            plan.pose(map_image, Poses(place, quat), RED)
        width = round(SIDE * image.shape[1] / image.shape[0])
        small = cv2.resize(image, (width, SIDE), interpolation=cv2.INTER_AREA)
        both = np.hstack([small, map_image])
        strip = np.full((STRIP, both.shape[1], 3), WHITE, np.uint8)
        text = f"{float(row['time_s']):5.1f} s   {row['state'].upper()}   {said(row)}"
        cv2.putText(strip, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, BLACK, 1, cv2.LINE_AA)
        yield np.vstack([both, strip])


def main() -> None:
    """Write the animation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("area", type=Path)
    parser.add_argument("run")
    parser.add_argument("flight")
    parser.add_argument("to", type=Path, help=".webp or .gif")
    parser.add_argument("--every", type=int, default=1, help="show every n-th image")
    given = parser.parse_args()
    shown = [
        Image.fromarray(picture[..., ::-1])
        for picture in islice(pictures(given.area, given.run, given.flight), 0, None, given.every)
    ]
    shown[0].save(
        given.to, save_all=True, append_images=shown[1:], duration=200, loop=0, quality=60, method=6
    )


if __name__ == "__main__":
    main()
