"""Rolling shutter and stabilisation are detected and measured in residuals, without false alarms."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.model import MapObservations, Scene, read_map
from spn_data.geometry.camera import Camera
from spn_data.geometry.least_squares import projection_jacobians
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.reconstruction.frame_jitter import most_likely_scatter
from spn_data.reconstruction.shutter import (
    ShutterDiagnosis,
    ShutterOptions,
    diagnose_shutter,
    world_twists,
)
from spn_data.simulate import preset, simulate_paths
from tests.worlds.native_world import native_model


@dataclass(frozen=True, kw_only=True)
class Flaws:
    """Imperfections of a camera that films a box of points along a simulated flight."""

    readout_s: float = 0.0
    zoom_jitter: float = 0.0
    zoom_drift: float = 0.0
    noise_px: float = 0.5
    wrong_share: float = 0.02  # share of observations that are outliers, by up to 4 px


@dataclass(frozen=True, eq=False)
class Filmed:
    """Bundle-adjusted model with its truth; displacement_p95_px is the true effect of the readout."""

    scene: Scene
    seen: MapObservations
    time_s: np.ndarray
    truth: Poses
    displacement_p95_px: float

    @property
    def sequences(self) -> np.ndarray:
        return np.array(["flight1"] * len(self.time_s))

    def diagnose(self, options: ShutterOptions | None = None) -> ShutterDiagnosis:
        (found,) = diagnose_shutter(self.scene, self.seen, self.sequences, self.time_s, options)
        return found


def box_of_points(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return points on and up to 3 m in front of the walls and the ground of a court of 40 x 36 x 18 m."""
    points = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 5, count)
    axis = np.minimum(face // 2, 2)
    sign = np.where((face % 2 == 1) & (face < 4), 1.0, -1.0)
    points[np.arange(count), axis] = sign * rng.uniform(0.85, 1, count)
    return points * [20.0, 18.0, 9.0] + [0.0, 0.0, 9.0]


@cache
def film(tmp: Path, seed: int, flaws: Flaws, frames: int = 38, iterations: int = 50) -> Filmed:
    """Project points exactly along a simulated flight, then run COLMAP's bundle adjustment on them."""
    rng = np.random.default_rng(seed)
    path = simulate_paths(preset("standard", seed=seed))["flight1"]
    time_s = 1.0 + 0.85 * np.arange(frames) + rng.uniform(-0.1, 0.1, frames)
    camera, truth = path.camera, path.motion.poses(time_s)
    size = np.array([camera.width, camera.height])
    points = box_of_points(rng, 4000)
    lens = Camera(
        "OPENCV",
        camera.width,
        camera.height,
        np.array([*camera.focal_px, *camera.matrix[:2, 2], *camera.opencv_distortion]),
    )
    tracks: dict[int, list[tuple[int, int]]] = {}
    moved, seen_in = [], []
    for k in range(frames):
        zoom = 1 + flaws.zoom_jitter * rng.standard_normal()
        zoom += flaws.zoom_drift * (k / (frames - 1) - 0.5)
        still = project(camera, truth[k : k + 1], points)
        pixels = still
        for _ in range(5 if flaws.readout_s else 0):
            row = np.clip(np.nan_to_num(pixels[:, 1]), 0, camera.height)
            when = time_s[k] + flaws.readout_s * (row / camera.height - 0.5)
            pixels = project(camera, path.motion.poses(when), points)
        pixels = (pixels - size / 2) * zoom + size / 2
        inside = np.flatnonzero(((pixels > 0) & (pixels < size)).all(axis=1))
        inside = np.sort(rng.choice(inside, min(250, len(inside)), replace=False))
        moved.append(np.linalg.norm(pixels[inside] - still[inside], axis=1))
        measured = pixels[inside] + flaws.noise_px * rng.standard_normal((len(inside), 2))
        wrong = rng.random(len(inside)) < flaws.wrong_share
        measured[wrong] += rng.uniform(-4, 4, (int(wrong.sum()), 2))
        seen_in.append(measured)
        for position, index in enumerate(inside.tolist()):
            tracks.setdefault(index, []).append((k, position))
    starts = [
        (points[index] + rng.normal(0, 0.02, 3), track)
        for index, track in tracks.items()
        if len(track) >= 3
    ]
    names = [f"flight1/{k:04d}.jpg" for k in range(frames)]
    model = native_model({1: lens}, [1] * frames, names, truth, seen_in, starts)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = iterations
    pycolmap.bundle_adjustment(model, options)
    model.write(str(tmp))
    scene, seen, _ = read_map(tmp)
    return Filmed(scene, seen, time_s, truth, float(np.percentile(np.concatenate(moved), 95)))


def project(camera: Camera, poses: Poses, points: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points (N, 3) with one pose for all or one pose each."""
    return camera.project(np.einsum("nij,nj->ni", poses.rotations, points - poses.centers))


@pytest.fixture(scope="module")
def tmp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("model")


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "readout_s"), [(1, 0.015), (3, 0.03), (4, -0.03)])
def test_a_rolling_shutter_is_measured_through_what_bundle_adjustment_hid(
    tmp: Path, seed: int, readout_s: float
) -> None:
    """After bundle adjustment, readout is within 8 %, displacement within 20 %, pose errors as reported."""
    filmed = film(tmp, seed, Flaws(readout_s=readout_s))
    found = filmed.diagnose()
    assert found.rolls
    assert not found.drifts
    assert found.jitters == ()
    assert found.readout_s == pytest.approx(readout_s, rel=0.08)
    assert 1e-4 < found.readout_sigma_s < 2e-3
    assert found.displacement_p95_px == pytest.approx(filmed.displacement_p95_px, rel=0.2)
    assert 0.03 < found.explained_share < 0.6
    truth_from_model = Similarity.fit(filmed.scene.poses.centers, filmed.truth.centers)
    error_m, turn_deg = pose_errors(
        truth_from_model.apply_to_poses(filmed.scene.poses), filmed.truth
    )
    told_m = found.pose_shift * truth_from_model.scale
    assert 0.5 < told_m / np.sqrt(np.mean(error_m**2)) < 2
    assert 0.4 < found.pose_turn_deg / np.sqrt(np.mean(turn_deg**2)) < 2.5
    assert "rolling shutter of about" in found.describe(1.0)


@pytest.mark.slow
def test_a_global_shutter_raises_no_alarm(tmp: Path) -> None:
    """Over 20 seeds a global shutter gives no warning, and the readout error agrees with its sigma."""
    found = [film(tmp, seed, Flaws(), 30, 12).diagnose() for seed in range(20)]
    assert [d.describe() for d in found] == [""] * 20
    scores = np.array([d.readout_s / d.readout_sigma_s for d in found])
    assert np.abs(scores).max() < 3.5
    assert 0.5 < np.sqrt(np.mean(scores**2)) < 1.6


def test_zoom_jitter_is_told_as_stabilisation_and_not_as_a_shutter(tmp: Path) -> None:
    """Zoom jitter of 0.5 % per frame is reported as stabilisation, with its size within a third."""
    found = film(tmp, 2, Flaws(zoom_jitter=0.005)).diagnose()
    assert found.jitters == ("zoom",)
    assert not found.rolls
    assert found.zoom_rms == pytest.approx(0.005, rel=0.33)
    assert 1.5 < found.jitter_p95_px < 6
    assert "frames differ in zoom by 0." in found.describe()


def test_a_drifting_focal_length_is_told(tmp: Path) -> None:
    """A focal length drifting by 2 % over the flight is reported, though partly absorbed as a bent scene."""
    found = film(tmp, 5, Flaws(zoom_drift=0.02)).diagnose()
    assert found.drifts
    assert not found.rolls
    assert 0.01 < found.zoom_drift < 0.025
    assert "focal length drifts by 1." in found.describe()


def test_blocks_of_a_long_flight_agree_with_the_whole(tmp: Path) -> None:
    """Linearising a long flight in three blocks gives the same readout within its uncertainty."""
    filmed = film(tmp, 5, Flaws(readout_s=0.02), 38, 8)
    whole = filmed.diagnose()
    parts = filmed.diagnose(ShutterOptions(max_block_frames=13))
    assert whole.frames == parts.frames == 36
    assert parts.readout_s != whole.readout_s
    assert abs(parts.readout_s - whole.readout_s) < 3 * parts.readout_sigma_s


def test_without_known_motion_the_shutter_is_undetermined(tmp: Path) -> None:
    """Photos 10 s apart, or all at one time, give no readout, no warning and no NaN in JSON."""
    filmed = film(tmp, 2, Flaws(zoom_jitter=0.005))
    for time_s in (10.0 * np.arange(38), np.zeros(38)):
        found = replace(filmed, time_s=time_s).diagnose()
        assert np.isnan([found.readout_s, found.displacement_p95_px, found.pose_shift]).all()
        assert not found.rolls
        assert found.jitters == ("zoom",)
        assert json.loads(json.dumps(found.counts(), allow_nan=False))["readout_s"] is None


def test_a_handful_of_frames_is_not_judged(tmp: Path) -> None:
    """Fewer frames than `min_frames` give no diagnosis, and arrays of unequal length raise an error."""
    filmed = film(tmp, 2, Flaws(zoom_jitter=0.005))
    sequences = np.array([f"part{k // 8}" for k in range(38)])
    assert diagnose_shutter(filmed.scene, filmed.seen, sequences, filmed.time_s) == ()
    with pytest.raises(ValueError, match="37 sequences for 38 images"):
        diagnose_shutter(filmed.scene, filmed.seen, sequences[1:], filmed.time_s)


def test_wild_and_unknown_residuals_do_not_change_the_finding(tmp: Path) -> None:
    """1 % of residuals at 1e7 px and 10 % NaN do not change the zoom; all NaN gives no diagnosis."""
    filmed = film(tmp, 2, Flaws(zoom_jitter=0.005))
    residuals = filmed.seen.residuals_px.copy()
    residuals[::100] = 1e7
    residuals[5::10] = np.nan
    found = replace(filmed, seen=replace(filmed.seen, residuals_px=residuals)).diagnose()
    assert found.zoom_rms == pytest.approx(filmed.diagnose().zoom_rms, rel=0.1)
    residuals[:] = 0
    assert (
        replace(filmed, seen=replace(filmed.seen, residuals_px=residuals)).diagnose().describe()
        == ""
    )
    residuals[:] = np.nan
    nothing = replace(filmed.seen, residuals_px=residuals)
    assert diagnose_shutter(filmed.scene, nothing, filmed.sequences, filmed.time_s) == ()


def test_twists_are_the_velocity_of_a_still_point_in_the_camera() -> None:
    """For a screw motion, twist x point equals the numerical derivative of the point's coordinates."""
    rate, speed = np.array([0.1, 0.5, -0.2]), np.array([2.0, -1.0, 0.5])

    def poses(time_s: np.ndarray) -> Poses:
        return Poses.from_rotations(
            time_s[:, None] * speed + np.sin(time_s)[:, None],
            rotations_from_vectors(time_s[:, None] * rate),
        )

    time_s = np.array([0.0, 0.4, 0.9, 1.3, 1.8, 2.2, 2.7, 9.0, 9.5, 10.0, 10.4])
    twists = world_twists(poses(time_s), time_s, max_gap_s=3.0)
    known = np.isfinite(twists).all(axis=1)
    assert known.tolist() == [False, *[True] * 5, False, False, True, True, False]
    point = np.array([3.0, 2.0, 7.0])

    def in_camera(time_s: np.ndarray) -> np.ndarray:
        p = poses(time_s)
        return np.einsum("nij,nj->ni", p.rotations, point - p.centers)

    velocity = (in_camera(time_s + 1e-5) - in_camera(time_s - 1e-5)) / 2e-5
    predicted = twists[:, :3] + np.cross(twists[:, 3:], in_camera(time_s))
    # A cubic through points half a second apart approximates the sine to about 1e-2.
    np.testing.assert_allclose(predicted[known], velocity[known], atol=0.03)


def test_projection_jacobians_are_the_derivatives_of_project() -> None:
    """Projection Jacobians equal central differences for all parameters of a lens with every distortion."""
    params = np.array([900.0, 880.0, 640.0, 350.0, -0.08, 0.02, 0.003, -0.002])
    points = np.random.default_rng(0).uniform([-2, -1, 3], [2, 1, 6], (20, 3))
    by_point, by_lens = projection_jacobians(Camera("OPENCV", 1280, 720, params), points)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        camera = Camera("OPENCV", 1280, 720, params)
        slope = (camera.project(points + step) - camera.project(points - step)) / 2e-6
        np.testing.assert_allclose(by_point[:, :, k], slope, rtol=1e-5, atol=1e-4)
    for k in range(8):
        step = 1e-5 * np.eye(8)[k]
        ends = [Camera("OPENCV", 1280, 720, params + s).project(points) for s in (step, -step)]
        np.testing.assert_allclose(by_lens[:, :, k], (ends[0] - ends[1]) / 2e-5, atol=1e-4)


def test_scatter_beyond_noise_is_found_among_unequal_noises() -> None:
    """Scatter of 4e-3 is detected under noise of 1e-5 to 1e-3, and none is reported if there is none."""
    rng = np.random.default_rng(3)
    noise = np.geomspace(1e-5, 1e-3, 60)
    quiet = noise * rng.standard_normal(60)
    assert most_likely_scatter(noise**2, quiet)[1] < 2
    size, sigmas = most_likely_scatter(noise**2, quiet + 4e-3 * rng.standard_normal(60))
    assert 3e-3 < size < 5e-3
    assert sigmas > 5
    size, sigmas = most_likely_scatter(np.full(60, 1e-4), quiet)
    assert np.isnan(size)
    assert sigmas == 0


def test_the_sentence_names_size_cause_and_remedy() -> None:
    """The message states size, cause and remedy, and flags a readout longer than that of any sensor."""
    found = ShutterDiagnosis(
        sequence="flight1", camera_id=1, frames=80, readout_s=0.0281, readout_sigma_s=0.0021,
        displacement_rms_px=2.2, displacement_p95_px=6.04, explained_share=0.4, pose_shift=0.05,
        pose_turn_deg=0.31, zoom_rms=0.0, shear_rms=0.0, stretch_rms=0.0, zoom_sigmas=0.0,
        shear_sigmas=0.0, stretch_sigmas=0.0, jitter_p95_px=0.0, zoom_drift=0.0,
        zoom_drift_sigma=1e-4, rolls=True, jitters=(), drifts=False,
    )  # fmt: skip
    assert found.describe(2.0) == (
        "flight1: rolling shutter of about 28 ms (sigma 2 ms) from first to last row moves points by "
        "up to 6.0 px; poses may be off by 10 cm and 0.31 degrees; fly slower or film with a "
        "mechanical or global shutter"
    )
    assert "poses may be off by 0.31 degrees; fly" in found.describe()
    assert "sensors are faster" in replace(found, readout_s=-0.09).describe()
    assert "from last to first row" in replace(found, readout_s=-0.09).describe()
    assert "off by 120 cm" in replace(found, pose_shift=1.234).describe(1.0)
    assert replace(found, rolls=False).describe() == ""
