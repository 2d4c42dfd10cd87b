"""Packed content of the 3D view: thinned and quantized points, cameras, GNSS fixes, places to fly again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spn_data.labels.map_points import MapPoints
from spn_data.report.data import FrameTable, ReportData
from spn_data.report.pack import pack, pack_texts
from spn_data.report.pictures import Pictures, pack_pictures

_STEPS = 32767  # of int16


@dataclass(frozen=True, eq=False)
class Display:
    """Transformation from the world to the view, ``shown = rotation @ (x - center)``, with up along z.

    radius : distance from the centre within which points are shown, in the world's unit.
    """

    rotation: np.ndarray  # (3, 3)
    center: np.ndarray  # (3,)
    radius: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) to the view."""
        return (points - self.center) @ self.rotation.T


def display_of(frames: FrameTable, points: MapPoints | None, *, has_up: bool) -> Display:
    """Choose a view centred on the cameras and the bulk of the points.

    If up is unknown, the cameras' mean upward direction is used instead, for display only.
    """
    centers = frames.poses.centers[frames.registered]
    rotation = np.eye(3)
    if not has_up and len(centers):
        rotation = _turn_to_z(-frames.poses[frames.registered].rotations[:, 1].mean(axis=0))
    bulk = points.xyz if points is not None and len(points) else centers
    if len(bulk) == 0:
        return Display(rotation, np.zeros(3), 1.0)
    low, high = np.percentile(bulk, [5, 95], axis=0)
    if len(centers):
        low, high = np.minimum(low, centers.min(axis=0)), np.maximum(high, centers.max(axis=0))
    center = (low + high) / 2
    # Some points of any map are far outside; with them, everything else would shrink to a dot.
    radius = 1.5 * float(np.linalg.norm(high - low) / 2)
    return Display(rotation, center, max(radius, 1e-6))


def _turn_to_z(up: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that takes a direction to z."""
    z = up / max(float(np.linalg.norm(up)), 1e-12)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def thin_points(points: MapPoints, display: Display, limit: int) -> tuple[np.ndarray, int]:
    """Sample at most `limit` points to show; return their rows and the number of points too far out."""
    near = np.linalg.norm(points.xyz - display.center, axis=1) <= display.radius
    rows = np.flatnonzero(near)
    if len(rows) > limit:
        rows = np.sort(np.random.default_rng(0).choice(rows, limit, replace=False))
    return rows, int((~near).sum())


def pack_points(points: MapPoints, display: Display, limit: int) -> dict[str, Any]:
    """Pack positions in multiples of `step`, colours, and how many points were omitted."""
    rows, far = thin_points(points, display, limit)
    step = display.radius / _STEPS
    return {
        "xyz": pack(np.round(display.apply(points.xyz[rows]) / step), "i2"),
        "rgb": pack(points.colors[rows], "u1"),
        "step": step,
        "shown": len(rows),
        "all": len(points),
        "far": far,
    }


def pack_frames(frames: FrameTable) -> dict[str, Any]:
    """Pack all columns of the frame table for the page's script."""
    numbers = {
        "time_s": frames.time_s,
        "center": frames.poses.centers,
        "quat": frames.poses.quats_wxyz,
        "sigma_m": frames.sigma_m,
        "sigma_deg": frames.sigma_deg,
        "error_px": frames.error_px,
        "gnss_m": frames.gnss_m,
    }
    texts = {
        "sequence": frames.sequences,
        "camera": frames.cameras,
        "status": frames.status,
        "reason": frames.reason,
        "stratum": frames.stratum,
        "group": frames.group,
    }
    flags = {
        "evaluation": frames.evaluation,
        "tracked": frames.tracked,
        "outlier": frames.gnss_outlier,
    }
    return {
        "count": len(frames),
        "name": frames.names.tolist(),
        "inliers": pack(frames.inliers, "i4"),
        **{name: pack(values, "f4") for name, values in numbers.items()},
        **{name: pack_texts(values) for name, values in texts.items()},
        **{name: pack(values, "u1") for name, values in flags.items()},
    }


def pack_scene(
    data: ReportData, frames: FrameTable, pictures: Pictures, max_points: int
) -> dict[str, Any]:
    """Pack everything that the page's script needs."""
    display = display_of(data.frames, data.points, has_up=data.units == "m")
    again = [p for facts in (data.coverage, data.plan) if facts for p in facts.fly_again]
    return {
        "units": data.units,
        "display": {
            "rotation": display.rotation.ravel().tolist(),
            "center": display.center.tolist(),
            "radius": display.radius,
        },
        "fov": {name: list(tangents) for name, tangents in data.fov_tan.items()},
        "frames": pack_frames(frames),
        **pack_pictures(pictures, frames),
        "points": None if data.points is None else pack_points(data.points, display, max_points),
        "again": [[*place.east_north_up_m, place.heading_deg, place.pitch_deg] for place in again],
    }
