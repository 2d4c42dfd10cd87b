"""Second attempt at frames that failed: carried into the map by accepted frames, and confirmed by the map.

A frame that sees little of the map may agree with a wrong place at first: some dozen of its matches happen to
fit one, in a small part of the image, and outnumber the few that are right. Its place is known, however, from
the accepted frames before and after it. The poses of the failed frames are therefore discarded and estimated
again from the features that they share with accepted frames, directly or through each other; their own
matches with the map are not used. Then the map is asked: its points are searched for where these poses put
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from spn_data.colmap.resection import Resection
from spn_data.labels.map_points import covered_share
from spn_data.registration.checks import Evidence, neighbour_votes
from spn_data.registration.frozen_map import FrozenMap
from spn_data.registration.map_search import AGREE_PX, search_map
from spn_data.registration.propagation import propagate_poses
from spn_data.registration.register_options import CheckOptions, RegisterOptions
from spn_data.registration.solution import (
    SequenceSolution,
    UnsolvedSequence,
    adjust_sequence,
    remove_frames,
)

_MAX_CHANCE = 1e-5  # that the map agrees as well with a wrong pose
_MIN_WITNESSES = 8  # cells of the image in which a map point is where the pose puts it
_MIN_AGREEING = 2  # neighbours


def carry_failed_frames(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    frozen: FrozenMap,
    describe: Callable[[int], np.ndarray],
    options: RegisterOptions,
) -> tuple[UnsolvedSequence, SequenceSolution] | None:
    """Pose failed frames by what they share with accepted ones, and keep those that the map confirms.

    Parameters
    ----------
    sequence : UnsolvedSequence
    solution : SequenceSolution
        Only accepted frames have poses.
    frozen : FrozenMap
    describe : callable
        Returns the descriptors (K, 128) of a frame's features.
    options : RegisterOptions

    Returns
    -------
    (UnsolvedSequence, SequenceSolution) or None
        The sequence has the map points found in the carried frames instead of their first matches, and only
        the tracks of frames with a pose. The solution holds all accepted and carried frames, adjusted
        together. None if the map confirms no frame.
    """
    accepted = solution.posed
    putative = [
        matches if accepted[row] else np.zeros((0, 2), np.int64)
        for row, matches in enumerate(sequence.putative)
    ]
    sequence = replace(sequence, putative=putative)
    resections, links = _links(sequence, solution, options)
    if len(resections) == np.count_nonzero(accepted):
        return None
    carried = adjust_sequence(
        sequence, resections, solution.camera, *links, solution.expected, options
    )
    unconfirmed = np.zeros(len(accepted), bool)
    for row in np.flatnonzero(carried.posed & ~accepted).tolist():
        search = search_map(
            sequence.pixels[row],
            describe(row),
            carried.poses[row : row + 1],
            carried.camera,
            frozen,
            options.matching,
        )
        if search.witnesses()[1] < _MIN_WITNESSES or search.chance() > _MAX_CHANCE:
            unconfirmed[row] = True
        else:
            putative[row] = search.matches[search.away_px <= 2 * AGREE_PX]
    # Frames that the map does not confirm share nothing from here on, and so stay without a pose.
    known = carried.posed & ~unconfirmed
    if not (known & ~accepted).any():
        return None
    sequence = replace(sequence, tracks=sequence.tracks.of_frames(known))
    resections, links = _links(sequence, remove_frames(carried, unconfirmed), options)
    return sequence, adjust_sequence(
        sequence, resections, carried.camera, *links, carried.expected, options
    )


def _links(
    sequence: UnsolvedSequence, solution: SequenceSolution, options: RegisterOptions
) -> tuple[dict[int, Resection], tuple[list[np.ndarray], np.ndarray, np.ndarray]]:
    """Extend the poses of a solution to frames that share enough with it.

    Returns the poses by frame, and putative matches, measurements of own points, and own points.
    """
    resections = {
        row: Resection(
            solution.poses[row : row + 1],
            np.ones(len(solution.inliers(row)[0]), bool),
            solution.camera,
        )
        for row in np.flatnonzero(solution.posed).tolist()
    }
    putative, own_points, own = propagate_poses(sequence, resections, solution.camera, options)
    return resections, (putative, own, own_points)


def check_carried(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    accepted: np.ndarray,
    evidence: Evidence,
    options: CheckOptions,
) -> np.ndarray:
    """Return which posed frames (N,) bool stand: the accepted ones, and carried ones with enough support.

    A carried frame needs as many points as any other, over as much of the image, but they may be points of
    the sequence's own; the same certainty of its pose; and two neighbours that agree with it, more than
    contradict it, through which it is connected to an accepted frame.
    """
    possible = accepted.copy()
    for row in np.flatnonzero(solution.posed & ~accepted).tolist():
        mine = solution.frame == row
        feature = np.unique(solution.feature[mine])
        pixels = sequence.pixels[row][feature]
        camera = solution.camera
        possible[row] = (
            len(feature) >= options.min_inliers
            and covered_share(pixels, camera.width, camera.height) >= options.min_coverage
            and evidence.sigma[row] <= options.max_sigma * evidence.depth[row]
            and evidence.sigma_deg[row] <= options.max_sigma_deg
        )
    agrees, contradicts = neighbour_votes(evidence, possible, options)
    stands = accepted.copy()
    while True:
        new = [
            row
            for row in np.flatnonzero(possible & ~stands).tolist()
            if len(agrees[row]) >= max(_MIN_AGREEING, len(contradicts[row]) + 1)
            and stands[agrees[row]].any()
        ]
        if not new:
            return stands
        stands[new] = True
