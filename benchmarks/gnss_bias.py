"""Monte Carlo evaluation of the stated uncertainty under a GNSS bias that lasts for the whole day.

    python benchmarks/gnss_bias.py [--draws 200] [--seed 1] [--cases NAME ...] [--json OUT]

The model of each draw is that of `benchmarks/georegister.py`. Its fixes have a constant error, the same for
all flights of a day; a drift over half an hour; errors of some 40 s, white noise and bursts. None of these
has the size or the correlation time that the fit assumes. Errors are relative to the ground truth, without
alignment.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import georegister as georegister_draws
import numpy as np
from georegister import Model, simulated_model

from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.pose import Similarity
from spn_data.georegistration import (
    GeoFit,
    GeoregisterOptions,
    align_telemetry,
    georegister,
    georegistration_errors,
)
from spn_data.simulate.flight import simulate_telemetry
from spn_data.simulate.gnss import GnssOptions, gnss_errors
from spn_data.simulate.presets import SimulateOptions, preset
from spn_data.telemetry.track import Telemetry

FIGURES = ("horizontal", "vertical", "tilt", "heading", "scale")
_DAY_S = 86400.0


@dataclass(frozen=True, kw_only=True)
class Receiver:
    """Errors of a receiver: constant bias of a day, drift with its correlation time, and the rest."""

    bias_m: tuple[float, float, float]
    drift_m: tuple[float, float, float]
    rest: GnssOptions
    drift_time_s: float = 1800.0
    sigma_m: float | None = None  # stated by the source
    absolute: bool = True  # heights above the ellipsoid, otherwise above take-off
    days: int = 1


CONSUMER = Receiver(
    bias_m=(0.9, 0.9, 2.3),
    drift_m=(0.5, 0.5, 1.0),
    rest=GnssOptions(bias_sigma_m=(0.5, 0.5, 0.8), bias_time_s=40.0, white_sigma_m=0.12),
)
CASES = {
    "absolute heights": CONSUMER,
    "two days": replace(CONSUMER, days=2),
    "heights above take-off": replace(
        CONSUMER, absolute=False, bias_m=(0.9, 0.9, 0.8), drift_m=(0.5, 0.5, 0.4)
    ),
    "rtk": Receiver(
        bias_m=(0.02, 0.02, 0.03), drift_m=(0.005, 0.005, 0.01), rest=GnssOptions.rtk(), sigma_m=0.03
    ),
}  # fmt: skip


def telemetry_of_draw(
    model: Model, options: SimulateOptions, receiver: Receiver, rng: np.random.Generator
) -> Telemetry:
    """Draw the telemetry of the model's frames."""
    drawn = replace(options, gnss=receiver.rest)
    tracks = {}
    drift = GnssOptions(
        bias_sigma_m=receiver.drift_m,
        bias_time_s=receiver.drift_time_s,
        white_sigma_m=0.0,
        burst_interval_s=float("inf"),
    )
    bias = rng.standard_normal((receiver.days, 3)) * receiver.bias_m
    for k, (name, path) in enumerate(model.paths.items()):
        track = simulate_telemetry(path, drawn)
        day = k % receiver.days
        enu = options.origin.enu_from_wgs84(
            np.column_stack([track.lat_lon_deg, options.origin.alt_m + track.rel_alt_m])
        )
        enu += bias[day] + gnss_errors(track.time_s, drift, rng)[0]
        place = options.origin.wgs84_from_enu(enu)
        n = len(place)
        tracks[name] = Telemetry.from_columns(
            track.time_s,
            lat_lon_deg=place[:, :2],
            abs_alt_m=place[:, 2] if receiver.absolute else None,
            rel_alt_m=None if receiver.absolute else enu[:, 2],
            gimbal_deg=np.round(track.gimbal_deg, 1),
            sigma_m=None if receiver.sigma_m is None else np.full((n, 3), receiver.sigma_m),
            utc_s=1.7e9 + day * _DAY_S + 600.0 * k + track.time_s,
            abs_reference=HeightReference.ELLIPSOID,
            kind="dji-srt",
        )
    return align_telemetry(tracks, model.sequence, model.time_s)


def sigmas_off(fit: GeoFit, model: Model, options: SimulateOptions) -> dict[str, float]:
    """Return the errors of a fit as multiples of the stated sigmas."""
    place = options.origin
    zero = 0.0 if fit.height_reference is HeightReference.TAKEOFF else place.alt_m
    shift = fit.origin.enu_from_wgs84(np.array([place.lat_deg, place.lon_deg, zero]))
    truth = model.world_from_model
    true = Similarity(truth.scale, truth.rotation, truth.translation + shift)
    stated = fit.uncertainty
    middle = fit.world_from_model.inverse().apply(stated.middle_m)
    errors = georegistration_errors(fit.world_from_model, true, middle[None])
    return {
        "horizontal": errors.horizontal_m / stated.horizontal_m,
        "vertical": abs(errors.vertical_m) / stated.vertical_m,
        "tilt": errors.tilt_deg / stated.tilt_deg,
        "heading": abs(errors.heading_deg) / stated.heading_deg,
        "scale": abs(errors.scale) / stated.scale,
    }


def evaluate(
    options: SimulateOptions,
    receiver: Receiver,
    draws: Sequence[int],
    fit_options: GeoregisterOptions | None = None,
) -> dict[str, Any]:
    """Return the shares of draws within two sigma, and the medians of what is stated."""
    off, stated = [], []
    for k in draws:
        model = simulated_model(options, k)
        rng = np.random.default_rng([options.seed, k, 23])
        drawn = replace(options, seed=300_000 + k)
        rows = telemetry_of_draw(model, drawn, receiver, rng)
        fit = georegister(model.poses, rows, model.sequence, model.time_s, fit_options)
        off.append(sigmas_off(fit, model, options))
        stated.append([fit.uncertainty.horizontal_m, fit.uncertainty.vertical_m,
                       fit.uncertainty.tilt_deg, fit.uncertainty.heading_deg,
                       fit.uncertainty.scale])  # fmt: skip
    return {
        "draws": len(off),
        "within_2_sigma": {
            name: float(np.mean([o[name] <= 2 for o in off])) for name in FIGURES
        },
        "stated": dict(zip(FIGURES, np.median(stated, axis=0).tolist(), strict=True)),
    }  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="random seed of the flight paths")
    parser.add_argument("--cases", nargs="*", help="run only these cases [default: all]")
    parser.add_argument("--no-bias", action="store_true", help="fit as if there were no bias")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--frames-per-s", type=float, default=georegister_draws.FRAMES_PER_S)
    args = parser.parse_args()
    georegister_draws.FRAMES_PER_S = args.frames_per_s
    options = preset("standard", seed=args.seed)
    fit_options = GeoregisterOptions(gnss_bias_m=(0.0, 0.0)) if args.no_bias else None
    figures = {}
    for name, receiver in CASES.items():
        if args.cases and name not in args.cases:
            continue
        found = evaluate(options, receiver, range(args.draws), fit_options)
        figures[name] = found
        print(f"{name}: {found['draws']} draws", flush=True)
        print("  within 2 sigma:", {n: f"{s:.1%}" for n, s in found["within_2_sigma"].items()})
        print("  stated (median):", {n: f"{s:.3g}" for n, s in found["stated"].items()})
    if args.json is not None:
        args.json.write_text(json.dumps(figures, indent=2, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
