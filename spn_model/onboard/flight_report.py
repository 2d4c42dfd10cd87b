"""Report on a flight: availability of fixes, longest outage, reasons for missing ones, time of each step."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spn_model.integrity.fix import Fix, NoFix

STEPS = ("texture", "patches", "features", "landmarks", "network", "judgement")


class StepTimes:
    """Times of the steps of images."""

    def __init__(self) -> None:
        self._seconds: dict[str, list[float]] = {}

    def add(self, steps_s: Mapping[str, float], whole_s: float) -> None:
        """Take the times of the steps of an image, and that of the whole image."""
        kind = "followed by patches" if "features" not in steps_s else "with features"
        for name, seconds in (*steps_s.items(), (f"image {kind}", whole_s), ("image", whole_s)):
            self._seconds.setdefault(name, []).append(seconds)

    def median_s(self) -> float:
        """Return the median time of an image; NaN without images."""
        return float(np.median(self._seconds.get("image", [math.nan])))

    def to_json(self) -> dict[str, dict[str, float]]:
        """Return the images with each step, and its time at 50 and 95 % of them."""
        wholes = sorted(name for name in self._seconds if name.startswith("image"))
        found = {}
        for name in (*STEPS, *wholes[::-1]):
            if name in self._seconds:
                p50, p95 = 1e3 * np.percentile(self._seconds[name], [50, 95])
                images = len(self._seconds[name])
                found[name] = {"images": images, "p50_ms": float(p50), "p95_ms": float(p95)}
        return found

    def lines(self) -> list[str]:
        """Return a table: images with the step, and its time at 50 and 95 % of them."""
        return [
            f"{'step':28} images  p50 ms  p95 ms",
            *(
                f"{name:28} {step['images']:6} {step['p50_ms']:7.1f} {step['p95_ms']:7.1f}"
                for name, step in self.to_json().items()
            ),
        ]


def kind_of_reason(reason: str) -> str:
    """Return a reason without its numbers, which differ from image to image."""
    return " ".join("#" if any(c.isdigit() for c in word) else word for word in reason.split())


def longest_outage(times: Sequence[float], usable: Sequence[bool]) -> float:
    """Return the longest time between usable fixes, begin and end included; 0 without images."""
    at = np.asarray(times)
    marks = np.concatenate([at[:1], at[np.asarray(usable, bool)], at[-1:]])
    return float(np.diff(marks).max(initial=0))


class FlightReport:
    """Counts of what was published during a flight."""

    def __init__(self) -> None:
        self._usable: list[bool] = []
        self._times_us: list[int] = []
        self._times = StepTimes()
        self._sources: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()
        self._levels_m: list[tuple[float, float]] = []

    def add(self, item: Fix | NoFix, steps_s: Mapping[str, float]) -> None:
        """Count an image, whose steps took these times."""
        usable = isinstance(item, Fix) and item.usable
        self._usable.append(usable)
        self._times_us.append(item.time_us)
        self._times.add(steps_s, item.processing_s)
        if isinstance(item, Fix) and item.usable:
            self._sources[item.source.value] += 1
            self._levels_m.append((item.horizontal_protection_m, item.vertical_protection_m))
        else:
            self._reasons[f"{item.state.value}: {kind_of_reason(item.reason)}"] += 1

    @property
    def availability(self) -> float:
        """Share of images with a usable fix."""
        return float(np.mean(self._usable)) if self._usable else 0.0

    @property
    def longest_outage_s(self) -> float:
        """Longest time between usable fixes, begin and end of the flight included."""
        return 1e-6 * longest_outage(self._times_us, self._usable)

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain values; protection levels are medians, None without a usable fix."""
        levels = np.median(self._levels_m, axis=0).tolist() if self._levels_m else (None, None)
        return {
            "images": len(self._usable),
            "usable": sum(self._usable),
            "longest_outage_s": self.longest_outage_s,
            "protection_horizontal_m": levels[0],
            "protection_vertical_m": levels[1],
            "sources": dict(self._sources),
            "reasons": dict(self._reasons),
            "steps": self._times.to_json(),
        }

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        if not self._usable:
            return ["No images."]
        usable = sum(self._usable)
        found = [
            f"Usable fixes: {usable} of {len(self._usable)} images ({100 * self.availability:.1f} %); "
            f"longest outage {self.longest_outage_s:.1f} s.",
            *self._times.lines(),
        ]
        if usable:
            horizontal, vertical = np.median(self._levels_m, axis=0)
            sources = ", ".join(f"{name} {count}" for name, count in self._sources.most_common())
            found.append(
                f"Protection level (median): {horizontal:.2f} m horizontally, {vertical:.2f} m vertically."
            )
            found.append(f"Sources: {sources}.")
        found += [
            f"No fix, {count} images: {reason}" for reason, count in self._reasons.most_common(8)
        ]
        return found
