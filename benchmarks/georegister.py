"""Monte Carlo evaluation of georegistration: many draws of GNSS and gimbal errors on one reconstruction.

    python benchmarks/georegister.py [--draws 200] [--seed 1] [--json OUT]
    python benchmarks/georegister.py --area AREA --flights FLIGHTS

Without an area, the model of each draw consists of the simulator's exact poses with 1 cm and 0.03 degrees
of noise and a common rotation error of 0.02 degrees, in an arbitrary gauge. With an area, its reconstruction
is used, FLIGHTS being the output of `spn-data simulate`; the draws replace its telemetry. The oracle is the
plain least-squares similarity of the true centres to the same fixes without bursts. Errors are relative to
the ground truth, without alignment.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.names import FRAMES_TABLE
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotation_vectors, rotations_from_vectors
from spn_data.georegistration import (
    GeoFit,
    GeoregisterOptions,
    align_telemetry,
    estimate_time_offset,
    georegister,
    georegistration_errors,
)
from spn_data.georegistration.uncertainty import radius_sigma
from spn_data.simulate.flight import FlightPath, simulate_paths, simulate_telemetry
from spn_data.simulate.gnss import GnssOptions
from spn_data.simulate.presets import MappingPaths, SimulateOptions, preset
from spn_data.telemetry.track import Telemetry

FRAMES_PER_S = 1.2
MODEL_SIGMA_M = 0.01
MODEL_SIGMA_DEG = 0.03
# Common rotation of a model's orientations relative to its positions; bundle adjustments of exact flights
# with 0.5 to 1 px of noise gave 0.003 to 0.05 degrees.
MODEL_BEND_DEG = 0.02
# The draws have no error that all fixes share; `benchmarks/gnss_bias.py` is about that.
NO_BIAS = GeoregisterOptions(gnss_bias_m=(0.0, 0.0))
FIGURES = ("position_m", "horizontal_m", "vertical_m", "tilt_deg", "heading_deg", "scale")


@dataclass(frozen=True, eq=False)
class Model:
    """A reconstruction of N frames of some flights, with its ground truth."""

    paths: dict[str, FlightPath]
    sequence: list[str]
    time_s: np.ndarray
    poses: Poses
    true: Poses
    world_from_model: Similarity


def simulated_model(options: SimulateOptions, draw: int = 0) -> Model:
    """Perturb the simulator's poses at about `FRAMES_PER_S` and move them to an arbitrary gauge."""
    paths = {n: p for n, p in simulate_paths(options).items() if p.role == "mapping"}
    rng = np.random.default_rng([options.seed, draw, 77])
    sequence: list[str] = []
    times, centers, rotations = [], [], []
    for name, path in paths.items():
        count = int(path.time_s[-1] * FRAMES_PER_S)
        chosen = np.sort(rng.choice(len(path.time_s), count, replace=False))
        sequence += [name] * count
        times.append(path.time_s[chosen])
        centers.append(path.poses.centers[chosen])
        rotations.append(path.poses.rotations[chosen])
    true = Poses.from_rotations(np.concatenate(centers), np.concatenate(rotations))
    n = len(true)
    shake = np.deg2rad(MODEL_SIGMA_DEG) * rng.standard_normal((n, 3))
    bend = rotations_from_vectors(np.deg2rad(MODEL_BEND_DEG) * rng.standard_normal(3))
    near = Poses.from_rotations(
        true.centers + MODEL_SIGMA_M * rng.standard_normal((n, 3)),
        rotations_from_vectors(shake) @ true.rotations @ bend,
    )
    turn = rotations_from_vectors(rng.standard_normal(3))
    model_from_world = Similarity(float(np.exp(rng.normal())), turn, 10 * rng.standard_normal(3))
    return Model(
        paths,
        sequence,
        np.concatenate(times),
        model_from_world.apply_to_poses(near),
        true,
        model_from_world.inverse(),
    )


def reconstructed_model(area: Path, flights: Path) -> tuple[Model, SimulateOptions]:
    """Read a real reconstruction of simulated flights, and the options of the simulation."""
    from spn_data.area.area import Area
    from spn_data.area.names import FRAMES, MODEL
    from spn_data.capture.frames import read_frames
    from spn_data.colmap.model import read_scene

    made = json.loads((flights / "truth" / "options.json").read_text(encoding="utf-8"))
    options = replace(
        preset(made["preset"], seed=made["seed"]),
        fps=made["fps"],
        area_factor=made["area_factor"],
        length_factor=made["length_factor"],
        mapping_paths=MappingPaths(made["mapping_paths"]),
    )
    paths = {n: p for n, p in simulate_paths(options).items() if p.role == "mapping"}
    folder = Area(area)
    scene = read_scene(folder.folder(MODEL))
    frames = read_frames(folder.folder(FRAMES) / FRAMES_TABLE)
    row = {name: k for k, name in enumerate(frames.names.tolist())}
    frames = frames.select(np.array([row[name] for name in scene.names]))
    sequence = frames.sequences.tolist()
    picked = [
        paths[s].poses[i : i + 1]
        for s, i in zip(sequence, frames.video_frame.tolist(), strict=True)
    ]
    true = Poses.concatenate(picked)
    world_from_model = Similarity.fit(scene.poses.centers, true.centers)
    return Model(paths, sequence, frames.time_s, scene.poses, true, world_from_model), options


def read_as_written(path: FlightPath, options: SimulateOptions, sigma_m: float | None) -> Telemetry:
    """Return the telemetry of a draw, rounded as in the subtitle file."""
    drawn = simulate_telemetry(path, options)
    return Telemetry.from_columns(
        drawn.time_s,
        lat_lon_deg=np.round(drawn.lat_lon_deg, 6) if sigma_m is None else drawn.lat_lon_deg,
        rel_alt_m=np.round(drawn.rel_alt_m, 3),
        gimbal_deg=np.round(drawn.gimbal_deg, 1),
        sigma_m=None if sigma_m is None else np.full((len(drawn.time_s), 3), sigma_m),
        kind="dji-srt",
    )


def fixes_of_draw(
    model: Model, options: SimulateOptions, sigma_m: float | None
) -> tuple[Telemetry, Telemetry]:
    """Return the telemetry of the frames, and the same without bursts."""
    calm = replace(options, gnss=replace(options.gnss, burst_interval_s=float("inf")))
    both = []
    for o in (options, calm):
        tracks = {name: read_as_written(path, o, sigma_m) for name, path in model.paths.items()}
        both.append(align_telemetry(tracks, model.sequence, model.time_s))
    return both[0], both[1]


def judge(fit: GeoFit, model: Model, options: SimulateOptions, calm: Telemetry) -> dict[str, Any]:
    """Return the errors of a fit and of the oracle, and the errors of the fit in stated sigmas."""
    # Origin of the truth in the frame of the fit: within the courtyard both have the same axes.
    true_origin = np.array([[options.origin.lat_deg, options.origin.lon_deg, 0.0]])
    shift = fit.origin.enu_from_wgs84(true_origin)[0] * [1, 1, 0]
    true = Similarity(
        model.world_from_model.scale,
        model.world_from_model.rotation,
        model.world_from_model.translation + shift,
    )
    errors = georegistration_errors(fit.world_from_model, true, model.poses.centers)
    fixes = fit.origin.enu_from_wgs84(np.column_stack([calm.lat_lon_deg, calm.rel_alt_m]))
    oracle = Similarity.fit(model.true.centers + shift, fixes)
    oracle_errors = georegistration_errors(
        oracle, Similarity.identity(), model.true.centers + shift
    )
    stated = fit.uncertainty
    middle = fit.world_from_model.inverse().apply(stated.middle_m)
    off = np.concatenate(
        [
            stated.middle_m - true.apply(middle),
            rotation_vectors(fit.world_from_model.rotation @ true.rotation.T),
            [np.log(fit.world_from_model.scale / true.scale)],
        ]
    )
    names = ("east", "north", "up", "tilt_east", "tilt_north", "heading", "scale")
    sigmas = dict(zip(names, off / np.sqrt(np.diag(stated.covariance)), strict=True))
    sigmas["horizontal"] = float(np.hypot(off[0], off[1]) / stated.horizontal_m)
    sigmas["tilt"] = errors.tilt_deg / stated.tilt_deg
    world = fit.world_from_model.apply(model.poses.centers)
    frame_m = np.linalg.norm(world - true.apply(model.poses.centers), axis=1)
    radius_m = np.array([radius_sigma(c) for c in stated.point_covariance(world)])
    return {
        "errors": {name: abs(getattr(errors, name)) for name in FIGURES},
        "oracle": {name: abs(getattr(oracle_errors, name)) for name in FIGURES},
        "sigmas": {name: float(abs(value)) for name, value in sigmas.items()},
        "stated": {
            name: getattr(stated, name)
            for name in ("horizontal_m", "vertical_m", "tilt_deg", "heading_deg", "scale")
        },
        "frames_within": float(np.mean(frame_m <= 2 * radius_m)),
        "outliers": fit.summary.outliers,
        "held_out_m": fit.held_out_blocks.horizontal_rmse_m,
        "in_sample_m": fit.summary.horizontal_rmse_m,
        "noise_m": fit.noise_m,
    }


def draw_many(
    model_of_draw: Callable[[int], Model],
    options: SimulateOptions,
    draws: int,
    sigma_m: float | None = None,
) -> dict[str, Any]:
    """Evaluate all draws; refused ones are counted separately."""
    model = model_of_draw(0)
    judged, refused = [], []
    begin = time.perf_counter()
    for k in range(draws):
        model = model_of_draw(k)
        drawn = replace(options, seed=100_000 + k)
        telemetry, calm = fixes_of_draw(model, drawn, sigma_m)
        try:
            fit = georegister(model.poses, telemetry, model.sequence, model.time_s, NO_BIAS)
        except GeometryError as error:
            refused.append(str(error))
            continue
        judged.append(judge(fit, model, drawn, calm))
    return {
        "draws": draws,
        "frames": len(model.poses),
        "refused": len(refused),
        "refusals": sorted(set(refused))[:3],
        "seconds_per_draw": (time.perf_counter() - begin) / draws,
        **_distributions(judged),
    }


def _distributions(judged: list[dict[str, Any]]) -> dict[str, Any]:
    if not judged:
        return {}
    figures: dict[str, Any] = {}
    for who in ("errors", "oracle", "stated"):
        figures[who] = {
            name: _quantiles(np.array([j[who][name] for j in judged])) for name in judged[0][who]
        }
    figures["within_2_sigma"] = {
        name: float(np.mean([j["sigmas"][name] <= 2 for j in judged]))
        for name in judged[0]["sigmas"]
    }
    figures["within_2_sigma"]["frames"] = float(np.mean([j["frames_within"] for j in judged]))
    tilt = np.array([j["errors"]["tilt_deg"] for j in judged])
    figures["tilt_at_most_0.7_deg"] = float(np.mean(tilt <= 0.7))
    figures["outliers"] = _quantiles(np.array([j["outliers"] for j in judged]))
    for name in ("held_out_m", "in_sample_m"):
        figures[name] = _quantiles(np.array([j[name] for j in judged]))
    figures["noise_m"] = {
        name: np.median([j["noise_m"][name] for j in judged], axis=0).tolist()
        for name in judged[0]["noise_m"]
    }
    return figures


def _quantiles(values: np.ndarray) -> dict[str, float]:
    levels = {"p5": 0.05, "median": 0.5, "p95": 0.95, "max": 1.0}
    return {name: float(np.quantile(values, q)) for name, q in levels.items()}


def draw_offsets(
    model: Model, options: SimulateOptions, draws: int, offset_s: float
) -> dict[str, Any]:
    """Evaluate the estimated time offset, flight by flight."""
    errors, sigmas, reasons = [], [], []
    sequence = np.array(model.sequence)
    for k in range(draws):
        drawn = replace(options, seed=200_000 + k)
        for name, path in model.paths.items():
            track = read_as_written(path, drawn, None).shifted(-offset_s)
            mine = sequence == name
            found = estimate_time_offset(model.poses[mine], model.time_s[mine], track)
            if found.offset_s is None:
                reasons.append(found.reason)
            else:
                errors.append(abs(found.offset_s - offset_s))
                sigmas.append(errors[-1] / found.sigma_s)
    figures: dict[str, Any] = {
        "flights": len(errors) + len(reasons),
        "undetermined": len(reasons),
        "reasons": sorted(set(reasons))[:3],
    }
    if errors:
        figures["error_s"] = _quantiles(np.array(errors))
        figures["within_0.1_s"] = float(np.mean(np.array(errors) <= 0.1))
        figures["within_2_sigma"] = float(np.mean(np.array(sigmas) <= 2))
    return figures


def show(title: str, figures: dict[str, Any]) -> None:
    """Print the distributions of one case."""
    print(f"\n{title}: {figures['draws']} draws, {figures['frames']} frames, "
          f"{figures['refused']} refused, {figures['seconds_per_draw']:.2f} s a draw")  # fmt: skip
    for text in figures["refusals"]:
        print(f"  refused: {text}")
    if "errors" not in figures:
        return
    print(f"  {'':14}{'median':>10}{'p95':>10}{'max':>10}   oracle {'median':>8}{'p95':>9}")
    for name in FIGURES:
        ours, oracle = figures["errors"][name], figures["oracle"][name]
        print(
            f"  {name:14}{ours['median']:10.4f}{ours['p95']:10.4f}{ours['max']:10.4f}"
            f"          {oracle['median']:8.4f}{oracle['p95']:9.4f}"
        )
    stated = {name: f"{q['median']:.4g}" for name, q in figures["stated"].items()}
    inside = {name: f"{share:.1%}" for name, share in figures["within_2_sigma"].items()}
    print(f"  stated (median): {stated}")
    print(f"  within 2 sigma: {inside}")
    print(f"  tilt at most 0.7 deg: {figures['tilt_at_most_0.7_deg']:.1%} of draws")
    print(f"  residual {figures['in_sample_m']['median']:.2f} m, held out "
          f"{figures['held_out_m']['median']:.2f} m; noise {figures['noise_m']}")  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="random seed of the flight paths")
    parser.add_argument("--cases", nargs="*", help="run only these cases [default: all]")
    parser.add_argument("--area", type=Path)
    parser.add_argument("--flights", type=Path)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args()
    options = preset("standard", seed=args.seed)
    model: Model | None = None
    if args.area is not None:
        model, options = reconstructed_model(args.area, args.flights)
    rtk = replace(options, gnss=GnssOptions.rtk())
    no_gimbal = replace(options, gimbal_angles=False)
    straight = replace(options, mapping_paths=MappingPaths.STRAIGHT)
    straight_no_gimbal = replace(straight, gimbal_angles=False)

    def case(drawn: SimulateOptions, sigma_m: float | None = None) -> dict[str, Any]:
        def model_of_draw(k: int) -> Model:
            reuse = model is not None and drawn.mapping_paths is options.mapping_paths
            return model if model is not None and reuse else simulated_model(drawn, k)

        return draw_many(model_of_draw, drawn, args.draws, sigma_m)

    cases: dict[str, Callable[[], dict[str, Any]]] = {
        "standard": lambda: case(options),
        "rtk": lambda: case(rtk, 0.03),
        "no gimbal": lambda: case(no_gimbal),
        "straight": lambda: case(straight),
        "straight, no gimbal": lambda: case(straight_no_gimbal),
    }
    figures: dict[str, Any] = {}
    for name, run in cases.items():
        if not args.cases or name in args.cases:
            figures[name] = run()
            show(name, figures[name])
    offset_draws = max(1, args.draws // 8)
    for name, drawn, source in (
        ("time offset", options, model),
        ("time offset, no gimbal", no_gimbal, model),
        ("time offset, straight, no gimbal", straight_no_gimbal, None),
    ):
        if not args.cases or name in args.cases:
            source = source or simulated_model(drawn)
            figures[name] = draw_offsets(source, drawn, offset_draws, 0.4)
            print(f"\n{name}: {json.dumps(figures[name], indent=1)}")
    if args.json is not None:
        args.json.write_text(json.dumps(figures, indent=2, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
