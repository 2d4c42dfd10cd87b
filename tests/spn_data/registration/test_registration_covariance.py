"""Stated covariances of evaluation frames against actual errors from measurements, lens and map."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotation_vectors, rotations_from_angles
from spn_data.registration.adjustment import (
    SequenceObservations,
    SequenceState,
    adjust,
    lens_parameters,
)
from spn_data.registration.covariance import SequenceCovariance, sequence_covariance
from spn_data.registration.frame_covariance import (
    LensUncertainty,
    PointObservations,
    frame_covariances,
)
from spn_data.uncertainty.map_covariance import (
    FunctionalCovariance,
    MapCovariance,
    MapCovarianceOptions,
)
from tests.spn_data.uncertainty.test_map_covariance import Small, small

CHI2_MEDIAN = 5.348
LENS = Camera("RADIAL", 640, 480, np.array([430.0, 320, 240, -0.08, 0.015]))
KNOWN = InitialLens(LENS, 1e-6, "given")
NAMES = lens_parameters(LENS)
NOISE_PX = 0.5
FRAMES, OWN = 5, 15
TRIALS = 40


def evaluation_poses() -> Poses:
    """Return poses inside the arc of the mapping frames, lower, looking at the same point cloud."""
    angle = np.linspace(0.4, 1.2, FRAMES)
    centers = np.stack([10 * np.sin(angle), -10 * np.cos(angle), np.full(FRAMES, 2.0)], axis=1)
    heading = np.rad2deg(-angle)
    turns = np.stack([heading, np.full(FRAMES, -3.0), np.zeros(FRAMES)], axis=1)
    return Poses.from_rotations(centers, rotations_from_angles(turns))


def observe(
    truth: Small, mapped: Small, rng: np.random.Generator, noise_px: float = NOISE_PX
) -> tuple[SequenceState, SequenceObservations, np.ndarray]:
    """Return the adjusted state of a noisy sequence in a noisy map, and rows (M,) of the map's points.

    Each frame sees four fifths of the map's points; the first points are used as the sequence's own.
    """
    poses = evaluation_poses()
    cloud = truth.scene.points
    frame, point, pixels = [], [], []
    for row in range(FRAMES):
        seen = LENS.project((cloud - poses.centers[row]) @ poses.rotations[row].T)
        inside = ((seen > 0) & (seen < [LENS.width, LENS.height])).all(axis=1)
        found = np.flatnonzero(inside & (rng.random(len(cloud)) < 0.8))
        frame.append(np.full(len(found), row))
        point.append(found)
        pixels.append(seen[found] + rng.normal(0, noise_px, (len(found), 2)))
    points = np.concatenate(point)
    mine = np.flatnonzero(np.bincount(points[points < OWN], minlength=OWN) >= 2)
    own = np.full(len(cloud), -1)
    own[mine] = np.arange(len(mine))
    keep = (points >= OWN) | (own[points] >= 0)
    points, own_rows = points[keep], own[points[keep]]
    observations = SequenceObservations(
        np.concatenate(frame)[keep],
        np.concatenate(pixels)[keep],
        np.where((own_rows >= 0)[:, None], np.nan, mapped.scene.points[points]),
        own_rows,
    )
    map_from_true = Similarity.fit(truth.scene.poses.centers, mapped.scene.poses.centers)
    start = SequenceState(
        map_from_true.apply_to_poses(poses), LENS, map_from_true.apply(cloud[mine]), KNOWN
    )
    state = adjust(start, observations, scale_px=50.0, lens=NAMES)
    return state, observations, np.where(own_rows >= 0, -1, points)


def errors(truth: Small, mapped: Small, state: SequenceState) -> np.ndarray:
    """Return truth minus estimate (N, 6) in the map's frame."""
    map_from_true = Similarity.fit(truth.scene.poses.centers, mapped.scene.poses.centers)
    true = map_from_true.apply_to_poses(evaluation_poses())
    turns = rotation_vectors(true.rotations @ np.swapaxes(state.poses.rotations, 1, 2))
    return np.concatenate([true.centers - state.poses.centers, turns], axis=1)


def deviations(covariances: np.ndarray) -> np.ndarray:
    """Return the standard deviations (N, 6)."""
    return np.sqrt(np.einsum("nii->ni", covariances))


@cache
def maps() -> list[tuple[Small, MapCovariance]]:
    """Bundle adjustments of the same flight under independent errors of half a pixel."""
    truth = small()
    rng = np.random.default_rng(11)
    found = []
    for _ in range(TRIALS):
        mapped = truth.noisy(rng.normal(0, NOISE_PX, truth.seen.pixels.shape))
        options = MapCovarianceOptions(clustered=False, exact_lenses=True)
        found.append((mapped, MapCovariance.of(mapped.scene, mapped.seen, options)))
    return found


def stated(
    state: SequenceState,
    observations: SequenceObservations,
    rows: np.ndarray,
    map_covariance: MapCovariance,
) -> SequenceCovariance:
    return sequence_covariance(state, observations, rows, map_covariance, NAMES)


def draw() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return scores (T,) with the map's errors, scores (T,) without, and z (T',) of the focal length."""
    truth = small()
    rng = np.random.default_rng(12)
    full, blind, focal = [], [], []
    for mapped, map_covariance in maps():
        state, observations, rows = observe(truth, mapped, rng)
        found = stated(state, observations, rows, map_covariance)
        own = stated(state, observations, rows, _Perfect())  # type: ignore[arg-type]
        error = errors(truth, mapped, state)
        full.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.poses), error))
        blind.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(own.poses), error))
        z = (state.camera.params[0] - LENS.params[0]) / np.sqrt(found.lens[0, 0])
        focal.append(z)
        assert found.lens_names == NAMES
        assert np.array_equal(found.poses, found.poses.transpose(0, 2, 1))
    return np.concatenate(full), np.concatenate(blind), np.array(focal)


class _Perfect:
    """Map without errors."""

    sigma_px = NOISE_PX

    def functional_covariances(self, functionals):  # type: ignore[no-untyped-def]
        return [
            FunctionalCovariance(*np.zeros((2, *[f.by_points.shape[0]] * 2))) for f in functionals
        ]


def test_errors_are_as_large_as_stated() -> None:
    """With lens, own points, noise and map, e^T C^-1 e follows chi-squared; without the map it does not."""
    full, blind, focal = draw()
    assert 0.7 < np.median(full) / CHI2_MEDIAN < 1.4
    assert (full > 22.5).mean() < 0.05
    assert np.median(blind) > 1.5 * np.median(full)
    assert 0.5 < np.sqrt((focal**2).mean()) < 1.6


def test_the_residuals_tell_the_noise() -> None:
    """The noise level is recovered from the residuals, and the map's contribution is never negative."""
    truth = small()
    mapped, map_covariance = maps()[0]
    state, observations, rows = observe(truth, mapped, np.random.default_rng(1))
    once = stated(state, observations, rows, _Perfect())  # type: ignore[arg-type]
    assert once.sigma_px == pytest.approx(NOISE_PX, rel=0.25)
    assert once.design_effect < 1.5
    whole = stated(state, observations, rows, map_covariance)
    assert np.all(np.linalg.eigvalsh(whole.poses - once.poses) > -1e-12)


def test_measurements_that_err_alike_weigh_less() -> None:
    """Three measurements that share one error count as fewer than three, through the design effect."""
    truth = small()
    mapped, map_covariance = maps()[0]
    state, observations, rows = observe(truth, mapped, np.random.default_rng(1), 0.1)
    pairs = np.repeat(np.arange(len(rows)), 3)
    crowded = SequenceObservations(
        observations.frame[pairs],
        observations.pixels[pairs],
        observations.map_xyz[pairs],
        observations.own[pairs],
    )
    state = adjust(state, crowded, scale_px=50.0, lens=NAMES)
    found = stated(state, crowded, rows[pairs], map_covariance)
    once = stated(state, observations, rows, map_covariance)
    assert once.design_effect < 1.2
    assert found.design_effect > 1.8  # robust weights keep it below 3
    exact = [
        stated(state, seen, of, _Perfect()).poses  # type: ignore[arg-type]
        for seen, of in ((crowded, rows[pairs]), (observations, rows))
    ]
    ratio = np.trace(exact[0].sum(axis=0)) / np.trace(exact[1].sum(axis=0))
    assert ratio > 0.6, "a third where the three were taken for independent"


def test_a_sequence_that_fits_the_map_badly_takes_the_map_for_bent() -> None:
    """If residuals are three times the map's, the map's contribution grows by (3 / 1.5) squared."""
    truth = small()
    mapped, map_covariance = maps()[0]
    state, observations, rows = observe(truth, mapped, np.random.default_rng(1))
    straight = stated(state, observations, rows, map_covariance)
    exact = stated(state, observations, rows, _Perfect())  # type: ignore[arg-type]
    finer = replace(map_covariance, sigma_px=straight.sigma_px / 3)
    bent = stated(state, observations, rows, finer)
    grown = (bent.poses - exact.poses) / (straight.poses - exact.poses)
    assert np.allclose(grown, 4.0)


def test_a_single_frame_is_stated_as_the_sequence_states_it() -> None:
    """A frame with the sequence's lens covariance is stated alike, but for what frames and lens share."""
    truth = small()
    mapped, map_covariance = maps()[0]
    state, observations, rows = observe(truth, mapped, np.random.default_rng(1))
    whole = stated(state, observations, rows, map_covariance)
    frames = []
    for k in range(FRAMES):
        mine = (observations.frame == k) & (rows >= 0)
        frames.append(
            PointObservations(observations.pixels[mine], rows[mine], observations.map_xyz[mine])
        )
    alone = frame_covariances(
        state.poses, state.camera, frames, LensUncertainty(covariance=whole.lens), map_covariance
    )
    assert (deviations(alone) > 0.9 * deviations(whole.poses)).all()  # errs on the safe side
    exact = stated(state, observations, rows, _Perfect())  # type: ignore[arg-type]
    alone = frame_covariances(
        state.poses,
        state.camera,
        frames,
        LensUncertainty(covariance=exact.lens),
        _Perfect(),  # type: ignore[arg-type]
    )
    assert np.allclose(deviations(alone), deviations(exact.poses), rtol=0.25)
    known = frame_covariances(state.poses, state.camera, frames, LensUncertainty(), map_covariance)
    assert np.all(np.linalg.eigvalsh(known) > 0)


def test_a_mapping_lens_is_uncertain_together_with_the_map() -> None:
    """Mapping frames relocated from their points alone have the stated errors, those of the lens included."""
    truth = small()
    camera_id = 1
    scores = []
    rng = np.random.default_rng(5)
    for mapped, map_covariance in maps():
        camera = mapped.scene.cameras[camera_id]
        true = truth.scene.cameras[camera_id]
        poses = evaluation_poses()
        map_from_true = Similarity.fit(truth.scene.poses.centers, mapped.scene.poses.centers)
        frames, found = [], []
        for k in range(FRAMES):
            seen = true.project((truth.scene.points - poses.centers[k]) @ poses.rotations[k].T)
            rows = np.flatnonzero(((seen > 0) & (seen < [true.width, true.height])).all(axis=1))
            pixels = seen[rows] + rng.normal(0, NOISE_PX, (len(rows), 2))
            frame = PointObservations(pixels, rows, mapped.scene.points[rows])
            start = SequenceState(
                map_from_true.apply_to_poses(poses[k : k + 1]), camera, np.zeros((0, 3)), KNOWN
            )
            only = SequenceObservations(
                np.zeros(len(rows), np.int64), pixels, frame.xyz, np.full(len(rows), -1)
            )
            found.append(adjust(start, only, scale_px=50.0, lens=()).poses)
            frames.append(frame)
        estimated = Poses(
            np.concatenate([p.centers for p in found]),
            np.concatenate([p.quats_wxyz for p in found]),
        )
        covariance = frame_covariances(
            estimated, camera, frames, LensUncertainty(camera_id=camera_id), map_covariance
        )
        state = SequenceState(estimated, camera, np.zeros((0, 3)), KNOWN)
        error = errors(truth, mapped, state)
        scores.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
    assert 0.7 < np.median(np.concatenate(scores)) / CHI2_MEDIAN < 1.4


def test_few_measurements_tell_the_noise_without_bias() -> None:
    """With ten points and six unknowns, the noise estimate is unbiased though residuals are smaller."""
    truth = small()
    rng = np.random.default_rng(8)
    poses = evaluation_poses()[:1]
    seen = LENS.project((truth.scene.points - poses.centers[0]) @ poses.rotations[0].T)
    rows = np.flatnonzero(((seen > 0) & (seen < [LENS.width, LENS.height])).all(axis=1))[::30][:10]
    variances = []
    for _ in range(60):
        observations = SequenceObservations(
            np.zeros(10, np.int64),
            seen[rows] + rng.normal(0, 0.1, (10, 2)),
            truth.scene.points[rows],
            np.full(10, -1),
        )
        start = SequenceState(poses, LENS, np.zeros((0, 3)), KNOWN)
        state = adjust(start, observations, scale_px=50.0, lens=())
        perfect = _Perfect()
        found = sequence_covariance(state, observations, rows, perfect, ())  # type: ignore[arg-type]
        variances.append(found.sigma_px**2)
        assert found.lens.shape == (0, 0)
    assert np.mean(variances) == pytest.approx(0.1**2, rel=0.15)


class _LensOnly:
    """Map with exact points and a lens covariance (8, 8)."""

    sigma_px = NOISE_PX

    def __init__(self, lens: np.ndarray):
        self.lens = lens

    def functional_covariances(self, functionals):  # type: ignore[no-untyped-def]
        assert all(f.camera_id == 7 for f in functionals)
        return [
            FunctionalCovariance(f.by_lens @ self.lens @ f.by_lens.T, np.zeros((6, 6)))
            for f in functionals
        ]


def test_a_lens_of_the_map_counts_as_one_of_the_sequence_with_the_same_covariance() -> None:
    """A lens covariance of the map has the same effect as an equal lens covariance of the sequence.

    The map's parameters are fx, fy, cx, cy, k1, k2, p1, p2; focal length, principal point and two distortion
    terms vary.
    """
    truth = small()
    mapped, _ = maps()[0]
    state, observations, rows = observe(truth, mapped, np.random.default_rng(1))
    mine = (observations.frame == 0) & (rows >= 0)
    frames = [PointObservations(observations.pixels[mine], rows[mine], observations.map_xyz[mine])]
    lens = np.diag([4.0, 2.0, 3.0, 1e-4, 4e-4])
    place = np.zeros((8, 5))
    place[[0, 1], 0] = place[2, 1] = place[3, 2] = place[4, 3] = place[5, 4] = 1.0
    own, of_map = (
        frame_covariances(state.poses[:1], state.camera, frames, uncertain, map_covariance)  # type: ignore[arg-type]
        for uncertain, map_covariance in (
            (LensUncertainty(covariance=lens), _Perfect()),
            (LensUncertainty(camera_id=7), _LensOnly(place @ lens @ place.T)),
        )
    )
    assert np.allclose(own, of_map, rtol=1e-9)
