"""Answers of workers are checked before they are stored, whatever a broken or hostile worker sends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spn_data.colmap.verify import VerifiedPair, check_pair
from spn_data.matching.features import FeatureOptions, Features, check_features
from spn_data.work.answers import (
    WrongAnswerError,
    check_asked,
    check_complete,
    check_indices,
    check_kind,
)

OPTIONS = FeatureOptions(max_features=5)
FEATURES = Features(np.ones((5, 4), np.float32), np.ones((5, 128), np.uint8))
ROWS = np.array([[0, 1], [4, 6]], np.uint32)
PAIR = VerifiedPair((1, 2), ROWS, ROWS[:1], 2, None, np.eye(3), None)


@pytest.mark.parametrize(
    ("features", "told"),
    [
        (b"features", "bytes instead of Features"),
        (replace(FEATURES, keypoints=[[1.0] * 4] * 5), "not an array of float32"),
        (
            replace(FEATURES, keypoints=FEATURES.keypoints.astype(np.float64)),
            "not an array of float32",
        ),
        (replace(FEATURES, keypoints=FEATURES.keypoints[:, :3]), r"the shape \(5, 3\)"),
        (replace(FEATURES, keypoints=FEATURES.keypoints * np.nan), "not all finite"),
        (
            replace(FEATURES, keypoints=FEATURES.keypoints[:4]),
            "numbers of keypoints and descriptors",
        ),
        (replace(FEATURES, descriptors=np.ones((5, 128), object)), "not an array of uint8"),
        (replace(FEATURES, descriptors=np.ones((6, 128), np.uint8)), "at most 5 rows"),
    ],
)
def test_features_that_cannot_be_are_refused(features, told):
    """Features of another kind, shape, number or without finite values are refused."""
    check_features(FEATURES, OPTIONS)
    with pytest.raises(WrongAnswerError, match=told):
        check_features(features, OPTIONS)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"matches": ROWS.astype(np.int64)}, "matches are not an array of uint32"),
        ({"matches": np.repeat(ROWS, 9, axis=0)}, "at most 12 rows"),
        ({"inliers": ROWS + np.uint32(1)}, "inliers refer to rows that do not exist"),
        ({"config": 99}, "a configuration 99"),
        ({"config": "2"}, "a configuration '2'"),
        ({"f": np.eye(4)}, r"a matrix of shape \(4, 4\)"),
        ({"h": [[1.0]]}, "list instead of ndarray"),
    ],
)
def test_pairs_that_cannot_be_are_refused(changes, told):
    """Pairs whose matches do not exist, or with other values than COLMAP's, are refused."""
    check_pair(PAIR, {1: 5, 2: 7})
    with pytest.raises(WrongAnswerError, match=told):
        check_pair(replace(PAIR, **changes), {1: 5, 2: 7})


@pytest.mark.parametrize(
    ("check", "told"),
    [
        (lambda: check_asked("b.jpg", {"a.jpg"}), "an answer to 'b.jpg', which was not asked"),
        (lambda: check_asked(["a.jpg"], {"a.jpg"}), "which was not asked"),
        (lambda: check_complete({"a.jpg"}), "workers left out 'a.jpg'"),
        (lambda: check_kind((1, 2, 3), tuple, 2), "3 items instead of 2"),
        (
            lambda: check_indices(-ROWS.astype(np.int64), "matches", np.int64, (9, 9), 9),
            "not exist",
        ),
    ],
)
def test_other_answers_are_refused(check: Callable[[], Any], told: str):
    """Answers that were not asked for, are missing or have another length are refused."""
    with pytest.raises(WrongAnswerError, match=told):
        check()


def test_an_answer_is_taken_once():
    """A second answer to the same question is refused."""
    asked = {"a.jpg"}
    check_asked("a.jpg", asked)
    check_complete(asked)
    with pytest.raises(WrongAnswerError, match="which was not asked"):
        check_asked("a.jpg", asked)
