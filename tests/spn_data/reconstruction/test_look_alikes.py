"""Pairs of images that show different places which look alike, in scenes with exact truth."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import write_native
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens
from spn_data.matching.pairs import PairOptions
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.look_alikes import checked_pairs, neighbours_in_time

N, BREAK = 20, 11  # frames, and the first frame of the second model


class _Flight:
    """Twenty frames in order, of which two models were made; some pairs match points of other places."""

    def __init__(self, folder: Path):
        self.database, self.models = folder / "database.db", [folder / "one", folder / "two"]
        pycolmap.set_random_seed(0)
        options = pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=N, num_points3D=300
        )
        with pycolmap.Database.open(self.database) as database:
            truth = pycolmap.synthesize_dataset(options, database)
        images = sorted(truth.images.values(), key=lambda image: image.name)
        self.names = tuple(image.name for image in images)
        self.centers = np.array([image.projection_center() for image in images])
        parts = [range(BREAK), range(BREAK, N)]
        turn = pycolmap.Rotation3d(np.array([0.3, -0.2, 0.1, 0.927]))
        for part, target in zip(parts, self.models, strict=True):
            model = pycolmap.Reconstruction(truth)
            for k in set(range(N)) - set(part):
                model.deregister_frame(images[k].frame_id)
            if part[0]:
                model.transform(pycolmap.Sim3d(2.5, turn, np.array([7.0, -3.0, 11.0])))
            write_native(model, target)

    def confuse(self, pairs: list[tuple[int, int]]) -> set[tuple[str, str]]:
        """Let pairs match points of other places; return their names."""
        rng, named = np.random.default_rng(0), set()
        with MapDatabase.open(self.database) as database:
            for i, j in pairs:
                ids = database.ids[self.names[i]], database.ids[self.names[j]]
                geometry = database._native.read_two_view_geometry(*ids)
                matches = geometry.inlier_matches.copy()
                matches[:, 1] = rng.permutation(matches[:, 1])
                geometry.inlier_matches = matches
                database._native.update_two_view_geometry(*ids, geometry)
                named.add((self.names[i], self.names[j]))
        return named

    def frames(self, positions_m: np.ndarray) -> FramesToMap:
        """Return the frames with fixes."""
        lens = InitialLens(Camera.from_horizontal_fov(640, 480, 60.0), True, GUESS_SIGMA)
        one = np.full(N, "flight1")
        return FramesToMap(Path("."), self.names, one, one, positions_m, {"flight1": lens}, {})

    def checked(self, positions_m: np.ndarray) -> set[tuple[str, str]]:
        """Return the pairs that agree with the models."""
        frames = self.frames(positions_m)
        neighbours = neighbours_in_time(frames, PairOptions())
        with MapDatabase.open(self.database) as database:
            return checked_pairs(database, self.models, frames, neighbours)

    def verified(self) -> set[tuple[str, str]]:
        """Return all pairs."""
        with MapDatabase.open(self.database) as database:
            return set(database.verified_pairs())


@pytest.fixture
def flight(tmp_path: Path) -> _Flight:
    """A flight of which neighbours in time made two models."""
    return _Flight(tmp_path)


def _all_but_some(rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return most of the pairs that are far apart in time, so that right ones are a minority."""
    far = [pair for pair in combinations(range(N), 2) if pair[1] - pair[0] > 4]
    return [far[k] for k in np.flatnonzero(rng.random(len(far)) < 0.7)]


def test_pairs_of_look_alike_places_are_left_out_and_all_others_kept(flight: _Flight) -> None:
    """Of pairs most of which match other places, exactly the right ones are kept, between two models too."""
    wrong = flight.confuse(_all_but_some(np.random.default_rng(1)))
    everything = flight.verified()
    assert len(wrong) > 0.4 * len(everything)
    assert flight.checked(flight.centers * 10.0) == everything - wrong


def test_two_models_are_not_joined_against_the_fixes(flight: _Flight) -> None:
    """Of two models that the fixes contradict, only pairs of neighbours in time are kept between them."""
    fixes = flight.centers * 10.0
    fixes[BREAK:] += [0.0, 300.0, 0.0]
    kept = flight.checked(fixes)
    sides = [{flight.names.index(name) < BREAK for name in pair} for pair in kept]
    across = [pair for pair, side in zip(kept, sides, strict=True) if len(side) == 2]
    assert all(abs(flight.names.index(a) - flight.names.index(b)) <= 4 for a, b in across)
    assert len(kept) - len(across) == sum(
        (i < BREAK) == (j < BREAK) for i, j in combinations(range(N), 2)
    )


def test_without_fixes_half_of_the_pairs_must_agree_to_join_two_models(flight: _Flight) -> None:
    """Without fixes two models are joined by a majority of the pairs between them, and not by a minority."""
    unknown = np.full((N, 3), np.nan)
    assert flight.checked(unknown) == flight.verified()
    wrong = flight.confuse(_all_but_some(np.random.default_rng(1)))
    kept = flight.checked(unknown)
    assert not kept & wrong
    far_across = [
        p
        for p in kept
        if (flight.names.index(p[0]) < BREAK - 4) and flight.names.index(p[1]) >= BREAK
    ]
    assert far_across == []


def test_neighbours_in_time_that_see_other_places_are_left_out(flight: _Flight) -> None:
    """A pair of neighbours in time is left out if their models contradict it."""
    wrong = flight.confuse([(3, 4), (15, 17)])
    assert flight.checked(flight.centers * 10.0) == flight.verified() - wrong
