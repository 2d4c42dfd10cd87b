"""Synthetic area for the tests of the report: a circular flight over a field and another one above it."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.georegistration.cross_validation import HeldOut
from spn_data.georegistration.result import FitSummary, GeoFit
from spn_data.georegistration.uncertainty import Uncertainty
from spn_data.labels.map_points import MapPoints
from spn_data.report.data import CoverageFacts, FrameTable, PlaceToFly, ReportData, StageFacts
from spn_data.report.pictures import COARSE, Pictures, RunEstimates, worst_frames
from spn_data.split import audit
from spn_data.split.groups import Split, SplitOptions
from spn_data.storage.stage_record import StageRecord


def flight(
    name: str, count: int, *, radius_m: float, height_m: float, failed: int = 0
) -> FrameTable:
    """Fly a circle looking inwards; the last `failed` frames have no pose."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centers = np.column_stack(
        [radius_m * np.cos(turn), radius_m * np.sin(turn), np.full(count, height_m)]
    )
    heading = np.rad2deg(np.arctan2(-centers[:, 0], -centers[:, 1])) % 360
    angles = np.column_stack([heading, np.full(count, -30.0), np.zeros(count)])
    poses = Poses.from_rotations(centers, rotations_from_angles(angles))
    has = np.arange(count) < count - failed
    poses = Poses(
        np.where(has[:, None], poses.centers, np.nan),
        np.where(has[:, None], poses.quats_wxyz, np.nan),
    )
    is_evaluation = name != "flight1"
    residuals = np.random.default_rng(1).normal(0, 0.4, (count, 3))
    return FrameTable(
        names=np.array([f"{name}/{k:06d}.jpg" for k in range(count)]),
        sequences=np.full(count, name),
        cameras=np.full(count, name),
        evaluation=np.full(count, is_evaluation),
        tracked=np.zeros(count, bool),
        time_s=np.arange(count) * 0.5,
        status=np.where(has, "registered", "failed"),
        reason=np.where(has, "", "failed: ambiguous"),
        poses=poses,
        sigma_m=np.where(has, np.linspace(0.01, 0.05, count), np.nan),
        sigma_deg=np.where(has, 0.02, np.nan),
        inliers=np.where(has, np.arange(count) % 300 + 20, 0),
        error_px=np.where(has, 0.4, np.nan),
        gnss_m=np.where(has[:, None] & (not is_evaluation), residuals, np.nan),
        gnss_outlier=np.arange(count) == 7,
        stratum=np.where(has & is_evaluation, "medium", ""),
        group=np.full(count, name if is_evaluation else "train", dtype="<U10"),
    )


def record(stage: str, **counts: object) -> StageRecord:
    """Return a plausible record of a stage."""
    return StageRecord(
        stage=stage,
        options={"seed": 0, "fit": {"heights": "auto"}},
        inputs={"flight1/flight1.mp4": "00ff"},
        upstream={},
        counts=dict(counts),
        seconds={"work": 12.0},
        notes=(f"A note of {stage}.",),
        versions={"numpy": "2.4"},
        finished="2026-05-01T10:00:00+00:00",
    )


def geo_fit(n: int) -> GeoFit:
    """Return a georegistration of N frames with plausible figures."""
    held_out = HeldOut(3, n, 0.5, 0.4, 0.6, 0.5)
    return GeoFit(
        world_from_model=Similarity.identity(),
        origin=GeoOrigin(49.0, 8.4, 115.0, HeightReference.ELLIPSOID),
        vertical_offsets_m={},
        residuals_m=np.zeros((n, 3)),
        outlier=np.zeros(n, bool),
        gravity_deg=np.zeros((n, 2)),
        gimbal_bias_deg={},
        noise_m={},
        uncertainty=Uncertainty(0.46, 0.64, 0.03, 0.41, 0.007, np.eye(7), np.zeros(3)),
        held_out_blocks=held_out,
        held_out_flights=held_out,
        summary=FitSummary(n, n, 1, 5.0, 0.4, 0.4, 0.7, 0.6, 0.05),
        observations=("fixes",),
        notes=(),
    )


def points(count: int) -> MapPoints:
    """Sample map points on a field with a wall along its northern edge."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-40, -40, 0], [40, 40, 0.3], (count, 3))
    xyz[: count // 4, 1:] = rng.uniform([39, 0], [40, 12], (count // 4, 2))
    return MapPoints(
        ids=np.arange(count),
        xyz=xyz,
        colors=rng.integers(40, 220, (count, 3)).astype(np.uint8),
        track_lengths=np.full(count, 4),
    )


def area(cameras: int = 150, map_points: int = 3000) -> ReportData:
    """Return a complete area that is ready to train on."""
    mapping = flight("flight1", cameras, radius_m=30, height_m=10)
    test = flight("medium", 40, radius_m=25, height_m=14, failed=2)
    frames = FrameTable.concatenate([mapping, test])
    frames.group[5:12] = "validation"
    stages = (
        record("1-frames", candidates=cameras, chosen=cameras, sequences=1),
        record("2-model", frames=cameras, registered=cameras, points=map_points, mean_error_px=0.4),
        record("3-geo"),
        record("4-eval/medium"),
        record("5-split"),
    )
    commands = ("reconstruct VIDEO", "reconstruct VIDEO", "georegister", "register VIDEO", "split")
    return ReportData(
        title="north",
        path="/data/north",
        made="2026-05-01 10:00 UTC",
        version="0.1.0",
        units="m",
        stages=tuple(
            StageFacts(r, None, f"spn-data {c}") for r, c in zip(stages, commands, strict=True)
        ),
        model_record=stages[1],
        geo=geo_fit(cameras),
        frames=frames,
        points=points(map_points),
        fov_tan={"flight1": (0.73, 0.41), "medium": (0.6, 0.34)},
        coverage=CoverageFacts(
            {"medium": {"high": 30, "medium": 6, "low": 2, "failed": 2}},
            (PlaceToFly((1.0, 2.0, 14.0), (49.000018, 8.4000137), 90.0, -30.0, 4),),
            "high: near; medium: less near; low: farther.",
        ),
        split=Split(frames.names, frames.group, frames.reason, SplitOptions()),
        audit=(
            audit.AuditFinding(
                "no evaluation frame in the map", audit.AuditVerdict.PASS, "none is"
            ),
            audit.AuditFinding("guard gap", audit.AuditVerdict.PASS, "kept"),
        ),
    )


def pictures(data: ReportData, off_m: float = 5.0) -> Pictures:
    """Return images of all frames but three, poses of a network that are off upwards, and fixes.

    The first fix is missing; the network's worst frame is the fifth of the flight, twice as far off.
    """
    frames = data.frames
    test = frames.select(frames.evaluation & frames.registered)
    n = len(test)
    off = np.full(n, off_m)
    off[4] *= 2
    up = np.array([0.0, 0.0, 1.0])
    missing = np.arange(n) == 0
    fixes = Poses(
        np.where(missing[:, None], np.nan, test.poses.centers),
        np.where(missing[:, None], np.nan, test.poses.quats_wxyz),
    )
    estimates = (
        RunEstimates(
            run="first",
            method=COARSE,
            names=test.names,
            poses=Poses(test.poses.centers + off[:, None] * up, test.poses.quats_wxyz),
            error=off,
            error_deg=np.zeros(n),
            reasons=np.full(n, ""),
        ),
        RunEstimates(
            run="first",
            method="search",
            names=test.names,
            poses=fixes,
            error=np.where(missing, np.nan, 0.0),
            error_deg=np.where(missing, np.nan, 0.0),
            reasons=np.where(missing, "too few landmarks agree", ""),
        ),
    )
    _, jpeg = cv2.imencode(".jpg", np.full((90, 160, 3), 128, np.uint8))
    return Pictures(
        estimates=estimates,
        worst=worst_frames(frames, estimates),
        thumbnails={name: jpeg.tobytes() for name in frames.names[3:].tolist()},
        files={name: f"1-frames/{name}" for name in frames.names.tolist()},
    )


def unpack(packed: dict[str, str]) -> np.ndarray:
    """Invert `pack` like the page's script: the array, flattened and rounded to its kind."""
    kinds = {"f4": "<f4", "i2": "<i2", "i4": "<i4", "u1": "|u1"}
    return np.frombuffer(base64.b64decode(packed["base64"]), dtype=kinds[packed["kind"]])
