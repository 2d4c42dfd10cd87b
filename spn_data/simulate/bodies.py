"""Motions of what is not static in a scene: walkers, cars, and crowns of trees in the wind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.simulate.faces import Placement


@dataclass(frozen=True, eq=False)
class Sway:
    """Crown of a tree in the wind: it sways as a whole, and its leaves shift on its surface."""

    amplitude_m: float
    phase: float

    def at(self, time_s: float) -> Placement:
        """Return its placement at a time."""
        gust = 0.65 + 0.35 * np.sin(2 * np.pi * time_s / 8.3 + self.phase)
        x = np.sin(2 * np.pi * time_s / 2.1 + self.phase)
        y = np.sin(2 * np.pi * time_s / 2.7 + 2.3 * self.phase)
        flutter = np.sin(2 * np.pi * time_s / 0.9 + 1.7 * self.phase)
        shift = self.amplitude_m * gust * np.array([x, 0.6 * y, 0.1 * flutter])
        # A leaf moves by some centimetres relative to the crown; the texture measures 6 m.
        scroll = self.amplitude_m * gust / 6.0
        return Placement(np.eye(3), shift, (float(scroll * flutter), float(scroll * x)))


@dataclass(frozen=True, eq=False)
class Ride:
    """Motion along a polyline at constant speed, which starts again at its first point.

    points : (K, 2) metres. start_m : position along the polyline at time zero. Faces at rest look east (+x)
    from the world's zero.
    """

    points: np.ndarray
    speed_m_s: float
    start_m: float
    bob_m: float = 0.0  # rise and fall at each step of a walker

    def at(self, time_s: float) -> Placement:
        """Return its placement at a time."""
        steps = np.diff(self.points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        along = (self.start_m + self.speed_m_s * time_s) % arc[-1]
        leg = int(np.clip(np.searchsorted(arc, along, side="right") - 1, 0, len(steps) - 1))
        direction = steps[leg] / lengths[leg]
        x, y = self.points[leg] + direction * (along - arc[leg])
        rotation = np.array(
            [[direction[0], -direction[1], 0], [direction[1], direction[0], 0], [0, 0, 1.0]]
        )
        up = self.bob_m * abs(np.sin(np.pi * along / 0.7))
        return Placement(rotation, np.array([x, y, up]))
