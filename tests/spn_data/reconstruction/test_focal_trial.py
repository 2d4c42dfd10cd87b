"""What is told of a focal length when its witnesses agree, differ, or cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.colmap.model import Scene
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, Hold, InitialLens
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.reconstruction.focal_trial import FocalTrial, Statement
from spn_data.reconstruction.view_variety import missing_views
from spn_data.uncertainty.shared_errors import FocalLength


def lens(focal_px: float) -> Camera:
    return Camera("RADIAL", 800, 600, np.array([focal_px, 400.0, 300.0, 0.0, 0.0]))


METADATA = InitialLens(lens(468.0), 0.02, "the sensor of FC300S")
GUESS = InitialLens(lens(960.0), GUESS_SIGMA, "guess")
SURE = FocalTrial("p1", lens(440.0), FocalLength(0.0, 1.0), METADATA, distance_m=60.0)


def test_agreement_is_one_line() -> None:
    """Three statements within their errors give one line with all of them, and no doubt."""
    trial = replace(SURE, adjusted=lens(470.0), gnss=Statement("GNSS", 465.0, 5.0))
    (note,) = trial.notes()
    assert "470 px (sigma 1)" in note
    assert "the sensor of FC300S 468 px (sigma 9)" in note
    assert "GNSS 465 px (sigma 5): they agree" in note
    assert trial.doubt_px == 0.0


def test_metadata_and_gnss_against_the_images_offer_to_hold() -> None:
    """The note says by how much heights may be off in percent and metres, and offers --fixed-lens."""
    trial = replace(SURE, gnss=Statement("GNSS", 461.0, 4.0))
    (note,) = trial.notes()
    assert "the sensor of FC300S 468 px (sigma 9) and GNSS 461 px (sigma 4) contradict" in note
    assert "may be wrong by 6.4% (3.8 m)" in note
    assert "--fixed-lens holds the stated focal length, which GNSS supports" in note
    assert trial.doubt_px == pytest.approx(28.0)


def test_gnss_alone_against_the_images_is_told_with_its_field_of_view() -> None:
    """Without metadata, what GNSS says is told as an option, and the difference is a doubt."""
    trial = replace(SURE, lens=GUESS, gnss=Statement("GNSS", 470.0, 5.0))
    (note,) = trial.notes()
    assert "GNSS would have it at --fov 80.8" in note
    assert trial.doubt_px == pytest.approx(30.0)


def test_a_witness_that_two_others_contradict_is_outvoted() -> None:
    """Images and metadata agree against GNSS: one line says so, and nothing is doubted."""
    trial = replace(SURE, adjusted=lens(470.0), gnss=Statement("GNSS", 430.0, 4.0))
    (note,) = trial.notes()
    assert note.endswith("GNSS is outvoted")
    assert trial.doubt_px == 0.0


def test_a_witness_without_an_opinion_is_not_heard() -> None:
    """Fixes that know the focal length to 12 % only are not quoted, and contradict nothing."""
    trial = replace(SURE, lens=GUESS, gnss=Statement("GNSS", 580.0, 70.0))
    assert trial.notes() == []
    assert trial.doubt_px == 0.0


def test_images_that_cannot_tell_say_so_with_what_all_say_together() -> None:
    """A focal length known to 6 % names the others, the metres, the option and the views to add."""
    trial = replace(
        SURE,
        images=FocalLength(25.0, 14.0),
        gnss=Statement("GNSS", 438.0, 23.0),
        missing=("oblique frames", "a second height"),
    )
    (note,) = trial.notes()
    assert "only to 6.5%: 440 px adjusted; images 465 px (sigma 14)" in note
    assert "together 464 px (sigma 7)" in note
    assert "6.5% (3.9 m)" in note
    assert "--fixed-lens holds the stated one" in note
    assert note.endswith("To determine it, add one of: oblique frames, a second height.")


def test_a_held_focal_length_that_gnss_contradicts_is_doubted() -> None:
    """A lens held at 5 % too little is not followed without a word."""
    held = InitialLens(lens(440.0), 0.005, "camera file", Hold.LENS)
    trial = replace(SURE, lens=held, images=None, gnss=Statement("GNSS", 465.0, 5.0))
    (note,) = trial.notes()
    assert "was held as 440 px" in note
    assert trial.doubt_px == pytest.approx(25.0)


def scene(pitch: np.ndarray, heading: np.ndarray, height: np.ndarray) -> Scene:
    """Return frames along a line and a second one beside it, above level ground."""
    n = len(pitch)
    centers = np.column_stack([5.0 * np.arange(n), 9.0 * (np.arange(n) % 2), height])
    turns = np.column_stack([heading, pitch, np.zeros(n)])
    poses = Poses.from_rotations(centers, rotations_from_angles(turns))
    ground = np.random.default_rng(0).uniform([-20, -20, 0], [120, 30, 1], (400, 3))
    names = tuple(f"{k:03d}.jpg" for k in range(n))
    return Scene(names, poses, np.ones(n, dtype=int), {1: lens(470.0)}, ground, np.full(400, 3))


def test_missing_views_are_named_from_the_poses() -> None:
    """A nadir flight lacks cross lines, oblique frames and a height, and less once it has them."""
    n = 20
    down, east, level = np.full(n, -80.0), np.full(n, 90.0), np.full(n, 60.0)
    alternating = np.arange(n) % 2
    one_way = missing_views(scene(down, east + 180.0 * alternating, level), 60.0)
    assert [name.split()[0] for name in one_way] == ["cross", "oblique", "a"]
    crossed = missing_views(scene(down, east + 90.0 * alternating, level), 60.0)
    assert [name.split()[0] for name in crossed] == ["oblique", "a"]
    two_heights = missing_views(
        scene(down, east + 90.0 * alternating, level + 25.0 * (np.arange(n) // 10)), 60.0
    )
    assert [name.split()[0] for name in two_heights] == ["oblique"]
    assert missing_views(scene(down + 60.0 * alternating, east, level), 60.0) == ()
