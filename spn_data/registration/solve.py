"""Poses and intrinsics of a sequence in the frozen map: from putative matches to one bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.colmap.resection import Resection, resect
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.pose import Poses
from spn_data.registration.adjustment import (
    SequenceObservations,
    SequenceState,
    adjust,
)
from spn_data.registration.propagation import propagate_poses
from spn_data.registration.register_options import RegisterOptions
from spn_data.registration.solution import (
    SCALE_PX,
    SequenceSolution,
    UnsolvedSequence,
    adjust_sequence,
    estimated_intrinsics,
)

_LENS_FRAMES = 60  # used for the initial intrinsics
_FOCAL_FRAMES = 12  # used for the initial focal length


def solve(
    sequence: UnsolvedSequence, start: InitialLens, options: RegisterOptions
) -> SequenceSolution:
    """Estimate the poses of all frames that agree with the map at all.

    Whether they are good enough is decided in `checks`.

    Parameters
    ----------
    sequence : UnsolvedSequence
    start : InitialLens
        Initial intrinsics. They are re-estimated, the principal point under a prior; none with `hold_lens`.
        A focal length that nothing states is first estimated by resections.
    options : RegisterOptions

    Returns
    -------
    SequenceSolution
    """
    camera = start.camera if options.hold_lens else radial(start.camera)
    if not (start.focal_is_known or options.hold_lens):
        camera = _guess_focal(sequence, camera, options)
    if not options.hold_lens:
        camera = _find_lens(sequence, camera, start, options)
    resections = {}
    for row in range(len(sequence.pixels)):
        pose = _resect(sequence, row, camera, options, max_error_px=options.max_error_px)
        if pose is not None:
            resections[row] = pose
    putative, own_points, own = propagate_poses(sequence, resections, camera, options)
    return adjust_sequence(sequence, resections, camera, putative, own, own_points, start, options)


def radial(camera: Camera) -> Camera:
    """Return the camera with two radial distortion terms, unchanged if it has them already."""
    if camera.model in ("RADIAL", "OPENCV"):
        return camera
    k1 = float(camera.opencv_distortion[0])
    f, (cx, cy) = float(np.mean(camera.focal_px)), camera.matrix[:2, 2]
    return Camera("RADIAL", camera.width, camera.height, np.array([f, cx, cy, k1, 0.0]))


def _with_focal(camera: Camera, focal_px: float) -> Camera:
    params = camera.params.copy()
    params[: 2 if camera.model == "OPENCV" else 1] = focal_px
    return replace(camera, params=params)


def _strongest(sequence: UnsolvedSequence, count: int) -> list[int]:
    """Return the frames with most putative matches."""
    sizes = np.array([len(m) for m in sequence.putative])
    return [int(row) for row in np.argsort(-sizes, kind="stable")[:count]]


def _guess_focal(sequence: UnsolvedSequence, camera: Camera, options: RegisterOptions) -> Camera:
    """Return the camera with the median focal length of resections, weighted by their inliers."""
    focals, weights = [], []
    for row in _strongest(sequence, _FOCAL_FRAMES):
        found = _resect(
            sequence, row, camera, options, max_error_px=options.start_error_px, find_focal=True
        )
        if found is not None and found.inliers.sum() >= options.checks.min_inliers:
            focals.append(found.camera.focal_px[0])
            weights.append(int(found.inliers.sum()))
    if not focals:
        return camera
    order = np.argsort(focals)
    half = np.searchsorted(np.cumsum(np.array(weights)[order]), sum(weights) / 2)
    return _with_focal(camera, float(np.array(focals)[order][half]))


def _find_lens(
    sequence: UnsolvedSequence, camera: Camera, expected: InitialLens, options: RegisterOptions
) -> Camera:
    """Estimate focal length and distortion from the frames that agree best, with decreasing thresholds."""
    rows = _strongest(sequence, _LENS_FRAMES)
    for max_error_px in (options.start_error_px, options.start_error_px / 2, options.max_error_px):
        poses: list[Poses] = []
        frame, pixels, places = [], [], []
        for row in rows:
            found = _resect(sequence, row, camera, options, max_error_px=max_error_px)
            if found is None or found.inliers.sum() < options.checks.min_inliers:
                continue
            kept = sequence.putative[row][found.inliers]
            frame.append(np.full(len(kept), len(poses)))
            pixels.append(sequence.pixels[row][kept[:, 0]])
            places.append(sequence.map_xyz[kept[:, 1]])
            poses.append(found.pose)
        if not poses:
            return camera
        observations = SequenceObservations(
            np.concatenate(frame),
            np.concatenate(pixels),
            np.concatenate(places),
            np.full(sum(map(len, frame)), -1),
        )
        state = SequenceState(Poses.concatenate(poses), camera, np.zeros((0, 3)), expected)
        lens = estimated_intrinsics(camera, len(poses), options)
        camera = adjust(state, observations, scale_px=SCALE_PX, lens=lens).camera
    return camera


def _resect(
    sequence: UnsolvedSequence,
    row: int,
    camera: Camera,
    options: RegisterOptions,
    *,
    max_error_px: float,
    find_focal: bool = False,
) -> Resection | None:
    """Resect a frame from its own matches with the map."""
    matches = sequence.putative[row]
    return resect(
        sequence.pixels[row][matches[:, 0]],
        sequence.map_xyz[matches[:, 1]],
        camera,
        max_error_px=max_error_px,
        find_focal=find_focal,
        seed=options.seed,
    )
