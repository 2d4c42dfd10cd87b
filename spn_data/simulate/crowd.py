"""People who walk and cars that drive or park."""

from __future__ import annotations

import numpy as np

from spn_data.simulate.bodies import Ride
from spn_data.simulate.shapes import Builder

SIDES = 5  # of a person
COLOURS = 6  # different sorts of clothes and cars


def register_textures(builder: Builder) -> None:
    """Register the textures of people and cars."""
    for k in range(COLOURS):
        builder.canvas(f"cloth-{k}", "cloth", (2.0, 2.0), 80.0)
        builder.canvas(f"car-{k}", "car", (4.2, 0.9), 80.0)
        # A texture of the same name has the same colour.
        builder.canvas(f"car-top-{k}", "car-top", (4.2, 1.7), 80.0, f"car-{k}")
    builder.canvas("car-glass", "car-glass", (2.2, 0.5), 80.0)


def add_car(builder: Builder, x: float, y: float, colour: int) -> None:
    """Add a car that looks east."""
    body, top = f"car-{colour}", f"car-top-{colour}"
    builder.box((x - 2.1, y - 0.85, 0.15), (x + 2.1, y + 0.85, 0.95), body, top)
    builder.box((x - 1.2, y - 0.75, 0.95), (x + 0.9, y + 0.75, 1.45), "car-glass", top)


def drive(builder: Builder, points: np.ndarray, speed_m_s: float, count: int) -> None:
    """Let cars drive along a polyline (K, 2), at random distances from each other."""
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    for k in range(count):
        start_m = (k + builder.rng.uniform(0.1, 0.7)) * length / count
        with builder.moving(Ride(points, speed_m_s, float(start_m))):
            add_car(builder, 0.0, 0.0, int(builder.rng.integers(COLOURS)))


def walk(builder: Builder, count: int, low: np.ndarray, high: np.ndarray) -> None:
    """Let people walk to and fro on straight lines between obstacles, within a rectangle low to high (2,)."""
    boxes = np.array([box for box in builder.obstacles if box[2] < 2.0])
    added = 0
    for _ in range(200 * count):
        if added == count:
            return
        start, end = builder.rng.uniform(low, high), builder.rng.uniform(low, high)
        if not 5.0 < np.linalg.norm(end - start) < 40.0:
            continue
        points = start + np.linspace(0, 1, 60)[:, None] * (end - start)
        gap = np.maximum(boxes[:, :2] - points[:, None], points[:, None] - boxes[:, 3:5])
        if len(boxes) and (gap.max(axis=2) < 0.5).any():
            continue
        added += 1
        ride = Ride(
            np.stack([start, end, start]),
            float(builder.rng.uniform(0.9, 1.6)),
            float(builder.rng.uniform(0, 50)),
            bob_m=0.04,
        )
        with builder.moving(ride):
            _person(builder)


def _person(builder: Builder) -> None:
    coat, legs = builder.rng.integers(COLOURS, size=2)
    tall = float(builder.rng.uniform(1.6, 1.9))
    builder.rings(f"cloth-{legs}", 0.0, 0.0, [(0.5 * tall, 0.17), (0.0, 0.13)], SIDES)
    body = [(0.84 * tall, 0.12), (0.8 * tall, 0.24), (0.48 * tall, 0.19)]
    builder.rings(f"cloth-{coat}", 0.0, 0.0, body, SIDES)
    builder.rings(
        "planks", 0.0, 0.0, [(tall, 0.05), (0.95 * tall, 0.1), (0.84 * tall, 0.08)], SIDES
    )
