"""Flights over each place: what the mapping and evaluation flights of a preset fly and look at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from spn_data.simulate.paths import Motion, courtyard_loop, guided, nadir_lines, straight_line
from spn_data.simulate.place import Place
from spn_data.simulate.presets import MappingPaths, SimulateOptions


@dataclass
class _Plan:
    """Flights planned so far: role, duration in seconds and motion by name."""

    options: SimulateOptions
    rng: Callable[[str], np.random.Generator]
    motions: dict[str, tuple[str, float, Motion]] = field(default_factory=dict)

    @property
    def half_m(self) -> tuple[float, float]:
        """Half the extent of the place."""
        return self.options.scene.half_m

    @property
    def side(self) -> float:
        """Factor of the duration of loops around the courtyard."""
        return float(np.sqrt(self.options.area_factor)) * self.options.length_factor

    def add(self, name: str, role: str, motion: Motion, duration_s: float) -> None:
        """Add a flight."""
        self.motions[name] = (role, duration_s, motion)

    def guide(
        self,
        name: str,
        role: str,
        stations: list[tuple[float, ...]],
        speed_m_s: float,
        sway_deg: float = 4.0,
    ) -> None:
        """Add a flight through stations: east and north for an area factor of one, up, heading, pitch."""
        side = float(np.sqrt(self.options.area_factor))
        motion, duration_s = guided(
            self.rng(name),
            np.array(stations) * [side, side, 1, 1, 1],
            speed_m_s=speed_m_s,
            length_factor=self.options.length_factor,
            sway_deg=sway_deg,
        )
        self.add(name, role, motion, duration_s)


def planned(
    options: SimulateOptions, rng: Callable[[str], np.random.Generator]
) -> dict[str, tuple[str, float, Motion]]:
    """Return role, duration in seconds and motion of each flight, mapping flights first.

    `rng` gives the random generator of a flight.
    """
    plan = _Plan(options, rng)
    _PLANS[options.place](plan)
    return plan.motions


def _plan_courtyard(plan: _Plan) -> None:
    if plan.options.mapping_paths == MappingPaths.NADIR:
        motion, duration_s = nadir_lines(plan.rng("nadir"), plan.half_m, plan.options.length_factor)
        plan.add("nadir", "mapping", motion, duration_s)
    elif plan.options.mapping_paths == MappingPaths.STRAIGHT:
        motion, duration_s = straight_line(
            plan.rng("straight"), plan.half_m, plan.options.length_factor
        )
        plan.add("straight", "mapping", motion, duration_s)
    else:
        _first_loop(plan)
        _second_loop(plan)
    _evaluation_loops(plan)


def _first_loop(plan: _Plan) -> None:
    # The first flight looks across the courtyard briefly, then at the facades ahead. The second one goes
    # the other way round and looks across for longer before it turns to the facades. Both see everything
    # from near and far.
    motion = courtyard_loop(
        plan.rng("flight1"), plan.half_m, duration_s=75 * plan.side, margin_m=8.0, turn=1,
        laps=1.25 * plan.options.length_factor,
        offsets_deg=[(0.0, 150.0), (0.1, 140.0), (0.32, 40.0), (0.75, 25.0), (1.0, 40.0)],
        height_m=(1.7, 8.8), pitch_deg=(-9.3, 14.3),
    )  # fmt: skip
    plan.add("flight1", "mapping", motion, 75 * plan.side)


def _second_loop(plan: _Plan) -> None:
    motion = courtyard_loop(
        plan.rng("flight2"), plan.half_m, duration_s=60 * plan.side, margin_m=5.5, turn=-1,
        laps=1.0 * plan.options.length_factor,
        offsets_deg=[(0.0, 165.0), (0.5, 190.0), (0.8, 45.0), (1.0, 30.0)],
        height_m=(1.7, 8.0), pitch_deg=(-9.3, 14.3),
    )  # fmt: skip
    plan.add("flight2", "mapping", motion, 60 * plan.side)


def _evaluation_loops(plan: _Plan) -> None:
    motion = courtyard_loop(
        plan.rng("medium"), plan.half_m, duration_s=30 * plan.side, margin_m=7.2, turn=1,
        laps=0.5 * plan.options.length_factor,
        offsets_deg=[(0.0, 40.0), (1.0, 28.0)], height_m=(2.5, 6.0), pitch_deg=(-9.0, 13.0),
    )  # fmt: skip
    plan.add("medium", "evaluation", motion, 30 * plan.side)
    motion = courtyard_loop(
        plan.rng("low"), plan.half_m, duration_s=25 * plan.side, margin_m=9.0, turn=-1,
        laps=0.62 * plan.options.length_factor,
        offsets_deg=[(0.0, 160.0), (0.5, 195.0), (1.0, 165.0)], height_m=(12.4, 20.6),
        pitch_deg=(-68.5, -47.0),
    )  # fmt: skip
    plan.add("low", "evaluation", motion, 25 * plan.side)


def _plan_modern(plan: _Plan) -> None:
    """Fly a loop, and close passes along two walls; evaluation also begins in front of a wall."""
    _first_loop(plan)
    plan.guide(
        "flight2",
        "mapping",
        [
            (17.9, 6.0, 2.0, 90, 0), (13.5, 6.0, 3.0, 90, 0), (16.0, 10.0, 3.2, 80, 2),
            (16.0, -11.0, 3.5, 100, 4), (13.0, -14.8, 3.5, 170, 4), (-13.0, -14.8, 4.0, 195, 3),
            (-12.0, -8.0, 5.0, 230, 0), (-10.0, 0.0, 6.0, 430, -4), (-10.0, 9.0, 6.0, 450, -5),
            (0.0, 10.0, 5.0, 520, -4), (9.0, 9.0, 4.0, 580, 0),
        ],
        1.7,
    )  # fmt: skip
    _evaluation_loops(plan)
    plan.guide(
        "close",
        "evaluation",
        [
            (9.0, 16.7, 2.0, 0, 0), (9.0, 12.5, 2.6, 0, 0), (10.0, 14.9, 3.0, -5, 3),
            (-12.0, 14.9, 3.4, 8, 2), (-16.4, 9.0, 3.2, -85, 3), (-16.4, -11.0, 3.0, -95, 2),
        ],
        1.7,
    )  # fmt: skip


def _plan_street(plan: _Plan) -> None:
    """Fly down the street and back looking at the fronts ahead, then along its middle."""
    plan.guide(
        "flight1",
        "mapping",
        [
            (-44, -2.0, 4.0, 35, 2), (44, -2.0, 6.5, 50, 4), (47, 0.0, 6.5, 150, 2),
            (44, 2.0, 6.0, 215, 2), (-44, 2.0, 4.0, 230, 4),
        ],
        2.4,
    )  # fmt: skip
    plan.guide(
        "flight2",
        "mapping",
        [
            (-40, 7.0, 2.0, 0, 0), (-40, 2.0, 3.0, 10, 0), (-30, 0.0, 5.0, 70, -4),
            (40, 0.0, 8.0, 95, -8), (44, 0.0, 8.0, 180, -8), (40, 0.0, 7.0, 260, -8),
            (-10, 0.0, 5.0, 275, -4),
        ],
        2.4,
    )  # fmt: skip
    plan.guide("medium", "evaluation", [(-40, 0.5, 4.5, 75, 2), (40, -0.5, 5.5, 110, 2)], 2.4, 8.0)
    plan.guide(
        "low", "evaluation", [(40, 0.0, 14.0, 250, -42), (-38, 0.0, 17.0, 285, -48)], 2.6, 8.0
    )
    plan.guide(
        "close",
        "evaluation",
        [(20, 7.2, 1.9, 0, 0), (20, 3.5, 2.6, 0, 0), (18, 5.4, 3.2, -8, 4), (-34, 5.4, 3.6, 6, 4)],
        1.8,
    )


def _plan_village(plan: _Plan) -> None:
    """Fly lines looking down, and lines across them looking obliquely; evaluate from above and below."""
    plan.guide("nadir", "mapping", _lines(50, 40, 6, 45.0, 90.0, -89.0), 7.0, 1.5)
    plan.guide("oblique", "mapping", _lines(40, 45, 5, 38.0, 10.0, -48.0, north=True), 7.0, 3.0)
    plan.guide("cross", "evaluation", _lines(32, 38, 3, 62.0, 180.0, -88.5, north=True), 7.0, 3.0)
    slant = [(-42, -20, 24.0, 60, -38), (30, -24, 26.0, 20, -40), (40, 24, 24.0, -60, -36)]
    plan.guide("slant", "evaluation", [*slant, (-10, 30, 22.0, -160, -34)], 5.0)


def _lines(
    reach_m: float,
    across_m: float,
    count: int,
    height_m: float,
    heading_deg: float,
    pitch_deg: float,
    *,
    north: bool = False,
) -> list[tuple[float, ...]]:
    """Return stations of `count` parallel lines, east-west unless `north`, with one heading."""
    stations: list[tuple[float, ...]] = []
    for k, offset in enumerate(np.linspace(-across_m, across_m, count)):
        for end in (-reach_m, reach_m) if k % 2 == 0 else (reach_m, -reach_m):
            x, y = (offset, end) if north else (end, offset)
            stations.append((float(x), float(y), height_m, heading_deg, pitch_deg))
    return stations


_PLANS: dict[Place, Callable[[_Plan], None]] = {
    Place.COURTYARD: _plan_courtyard,
    Place.MODERN: _plan_modern,
    Place.STREET: _plan_street,
    Place.VILLAGE: _plan_village,
}
