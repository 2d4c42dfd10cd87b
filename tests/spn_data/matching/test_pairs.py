"""Selection of image pairs."""

from __future__ import annotations

import numpy as np

from spn_data.matching.pairs import (
    PairOptions,
    appearance_pairs,
    choose_pairs,
    sequence_pairs,
    spatial_pairs,
    visual_vocabulary,
    vlad_descriptor,
)


def test_frames_pair_with_the_next_ones_of_their_own_sequence_only() -> None:
    """Frames are paired with the following frames of their own sequence only."""
    sequences = np.array(["a", "a", "a", "b", "b"])
    assert sequence_pairs(sequences, PairOptions(overlap=1, far_steps=0)) == {
        (0, 1),
        (1, 2),
        (3, 4),
    }


def test_further_steps_double() -> None:
    """The distances to further frames of a sequence double."""
    pairs = sequence_pairs(np.array(["a"] * 10), PairOptions(overlap=1, far_steps=3))
    assert {j for i, j in pairs if i == 0} == {1, 2, 4, 8}


def test_neighbours_in_space_are_found_across_sequences_and_unknown_positions_pair_with_none() -> (
    None
):
    """Nearby frames of different sequences are paired; frames without a position are not."""
    positions = np.array([[0.0, 0, 0], [100, 0, 0], [1, 0, 0], [np.nan, 0, 0]])
    options = PairOptions(spatial_neighbors=3, spatial_max_m=60.0)
    assert spatial_pairs(np.array(["a", "b", "c", "d"]), positions, options) == {(0, 2)}


def test_of_one_flight_neighbouring_lines_are_paired_and_what_lies_straight_on_is_not() -> None:
    """On two opposite flight lines of five photos, 20 m apart, photo k is paired with photo 9 - k."""
    east = np.array([0.0, 30, 60, 90, 120])
    lines = [np.stack([e, np.full(5, n)], axis=1) for e, n in ((east, 0.0), (east[::-1], 20.0))]
    positions = np.column_stack([np.concatenate(lines), np.full(10, 50.0)])
    options = PairOptions(spatial_neighbors=1, spatial_max_m=60.0)
    found = spatial_pairs(np.array(["a"] * 10), positions, options)
    assert found >= {(0, 9), (1, 8), (2, 7), (3, 6)}  # (4, 5) are consecutive
    assert all(i < 5 <= j for i, j in found)


def test_pairs_are_sorted_unique_and_ordered() -> None:
    """Pairs are sorted and unique, with the smaller index first."""
    rng = np.random.default_rng(0)
    pairs = choose_pairs(
        np.array(["a"] * 12 + ["b"] * 12), rng.normal(size=(24, 3)), None, PairOptions()
    )
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)


def test_a_place_seen_again_is_found_by_appearance() -> None:
    """Frame k + 20 has noisy descriptors of frame k and is paired with it by appearance."""
    rng = np.random.default_rng(1)
    first = [rng.gamma(0.5, 40, size=(300, 128)).clip(0, 255) for _ in range(20)]
    again = [np.clip(d[:200] + rng.normal(0, 4, size=(200, 128)), 0, 255) for d in first]
    descriptors = [d.astype(np.uint8) for d in [*first, *again]]
    options = PairOptions(overlap=3, far_steps=1, appearance_neighbors=1, words=16)
    vocabulary = visual_vocabulary(descriptors, options)
    appearance = np.stack([vlad_descriptor(d, vocabulary) for d in descriptors])
    pairs = appearance_pairs(np.array(["a"] * 40), appearance, options)
    assert {(k, k + 20) for k in range(20)} <= pairs
    assert len(pairs) < 30


def test_an_image_without_features_does_not_stop_the_others() -> None:
    """Images without features give an empty appearance vector instead of an error."""
    none = np.zeros((0, 128), np.uint8)
    vocabulary = visual_vocabulary([none, none], PairOptions())
    assert vlad_descriptor(none, vocabulary).shape == (0,)


def test_few_distinct_features_make_a_vocabulary_without_a_warning() -> None:
    """Three distinct descriptors give a finite, normalised appearance vector without a warning."""
    few = np.random.default_rng(0).integers(0, 255, (3, 128)).astype(np.uint8)
    vocabulary = visual_vocabulary([np.repeat(few, 40, axis=0)], PairOptions())
    appearance = vlad_descriptor(few, vocabulary)
    assert np.isfinite(appearance).all()
    assert np.linalg.norm(appearance) < 1.001
