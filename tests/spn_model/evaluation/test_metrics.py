"""Tests of error metrics, on poses with exactly known errors."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtri

from spn_data.dataset.hdf5_schema import DatasetInfo
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors
from spn_model.evaluation.calibration import calibrate, is_covariance, nees, sigmas
from spn_model.evaluation.metrics import (
    ENU,
    Estimates,
    EvaluationFrames,
    MetricOptions,
    axes_of,
    evaluate,
    evaluation_frames,
    frame_errors,
    quantile,
)
from spn_model.evaluation.tables import header, paper_rows, rows, write_errors, write_metrics


def poses(centers, vectors=None):
    """Return poses at centres with rotations from rotation vectors (default: identity)."""
    centers = np.asarray(centers, float)
    vectors = np.zeros_like(centers) if vectors is None else np.asarray(vectors, float)
    return Poses.from_rotations(centers, rotations_from_vectors(vectors))


def frames_of(true, strata=None, nearest_m=None):
    n = len(true)
    return EvaluationFrames(
        "medium",
        np.array([f"medium/{k:06d}.jpg" for k in range(n)]),
        np.array(strata if strata is not None else ["medium"] * n),
        true,
        np.zeros(n) if nearest_m is None else np.asarray(nearest_m, float),
        np.zeros(n),
    )


def without_pose(found, row):
    """Return the same estimates, with the pose of one frame unknown."""
    centers = found.centers.copy()
    centers[row] = np.nan
    return Poses(centers, found.quats_wxyz)


def test_figures_of_four_known_errors():
    """Errors of 1, 2, 3 and 6 m east and 0 to 30 deg give the statistics computed by hand."""
    true = poses(np.zeros((4, 3)))
    turned = np.zeros((4, 3))
    turned[:, 2] = np.deg2rad([0, 10, 20, 30])
    found = poses([[1, 0, 0], [2, 0, 0], [3, 0, 0], [6, 0, 0]], turned)
    summary = evaluate(Estimates("net", found), frames_of(true)).summary
    assert (summary.frames, summary.located) == (4, 4)
    assert (summary.position.median, summary.position.mean) == (2.5, 3.0)
    assert summary.position.p95 == pytest.approx(3 + 0.85 * 3)
    assert summary.rotation_deg.median == pytest.approx(15)
    assert summary.rotation_deg.p95 == pytest.approx(28.5)
    # Within 5 m: three; of them within 10 deg: the first, and the second at exactly 10 to rounding.
    options = MetricOptions(within=((0.25, 2.0), (5.0, 9.0), (5.0, 11.0), (6.0, 31.0)))
    summary = evaluate(Estimates("net", found), frames_of(true), options).summary
    assert [part.share for part in summary.within] == [0.0, 0.25, 0.5, 1.0]


def test_nothing_is_aligned():
    """Estimates that share a 7 m offset count as 7 m wrong, whatever their shape."""
    rng = np.random.default_rng(0)
    true = poses(rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    found = Poses(true.centers + np.array([2.0, 3.0, 6.0]), true.quats_wxyz)
    summary = evaluate(Estimates("net", found), frames_of(true)).summary
    for value in (summary.position.median, summary.position.mean, summary.position.p95):
        assert value == pytest.approx(7)
    assert [axis.signed_mean for axis in summary.axes] == pytest.approx([2, 3, 6])


def test_heights_that_are_too_low_are_negative_up():
    """The signed error is estimated minus true; only the absolute error drops the sign."""
    true = poses([[0, 0, 10], [0, 0, 12], [0, 0, 20]])
    found = poses([[0, 0, 9], [0, 0, 8], [0, 0, 22]])
    axes = evaluate(Estimates("net", found), frames_of(true)).summary.axes
    assert [axis.axis for axis in axes] == list(ENU)
    assert (axes[2].signed_median, axes[2].signed_mean) == (-1, -1)
    assert (axes[2].absolute_median, axes[0].absolute_median) == (2, 0)


def test_a_frame_without_a_pose_is_infinitely_wrong():
    """A frame without a pose counts in medians and shares, not in means, and never gets a pose."""
    true = poses(np.zeros((4, 3)))
    found = without_pose(poses([[1, 0, 0], [2, 0, 0], [3, 0, 0], [0, 0, 0]]), 3)
    one = evaluate(Estimates("net", found), frames_of(true), MetricOptions(within=((10.0, 10.0),)))
    summary = one.summary
    assert (summary.frames, summary.located) == (4, 3)
    assert summary.position.median == 2.5  # of 1, 2, 3, infinite
    assert summary.position.mean == 2.0
    assert math.isinf(summary.position.p95)
    assert summary.within[0].share == 0.75
    assert summary.axes[0].signed_mean == 2.0
    assert math.isinf(summary.axes[0].absolute_p95)
    assert one.errors.located.tolist() == [True, True, True, False]


def test_quaternions_of_both_signs_are_one_rotation():
    """A negated quaternion has no rotation error."""
    true = poses(np.zeros((1, 3)), [[0.3, -0.2, 0.9]])
    found = Poses(true.centers, -true.quats_wxyz)
    errors = frame_errors(Estimates("net", found), true)
    assert errors.error_deg[0] == pytest.approx(0, abs=1e-12)


def test_an_estimate_that_is_no_rotation_is_refused():
    """An estimate with an unnormalised quaternion raises ValueError."""
    true = poses(np.zeros((1, 3)))
    found = Poses(true.centers, 1.1 * true.quats_wxyz)
    with pytest.raises(ValueError, match="not normalised"):
        evaluate(Estimates("net", found), frames_of(true))


def test_truth_without_a_pose_is_refused():
    """A frame with unknown true pose, or a different number of estimates, raises ValueError."""
    true = poses(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="true pose"):
        frame_errors(Estimates("net", true), without_pose(true, 1))
    with pytest.raises(ValueError, match="1 estimated poses for 2"):
        frame_errors(Estimates("net", true[:1]), true)


def test_strata_are_judged_apart():
    """Each stratum has statistics of its own frames; frames without one are 'unknown'."""
    true = poses(np.zeros((5, 3)))
    found = poses([[1, 0, 0], [2, 0, 0], [4, 0, 0], [8, 0, 0], [16, 0, 0]])
    strata = ["high", "low", "high", "low", ""]
    found = evaluate(Estimates("net", found), frames_of(true, strata)).strata
    assert {name: s.position.median for name, s in found.items()} == {
        "high": 2.5,
        "low": 5.0,
        "unknown": 16.0,
    }
    assert sum(s.frames for s in found.values()) == 5


def test_curve_has_every_frame_once():
    """Bins are closed below and open above, the last one is unbounded, and empty ones are omitted."""
    true = poses(np.zeros((5, 3)))
    found = poses([[1, 0, 0], [3, 0, 0], [5, 0, 0], [7, 0, 0], [9, 0, 0]])
    options = MetricOptions(bin_edges_m=(0, 1, 2, 10))
    one = evaluate(
        Estimates("net", found), frames_of(true, nearest_m=[0, 0.999, 2, 10, 1e6]), options
    )
    assert [(b.low, b.high, b.frames) for b in one.curve] == [
        (0, 1, 2),
        (2, 10, 1),
        (10, np.inf, 2),
    ]
    assert [b.position_median for b in one.curve] == [2, 5, 8]
    assert (one.curve[0].position_q25, one.curve[0].position_q75) == (1.5, 2.5)


def test_distance_to_training_weighs_angle():
    """A training pose 1 m away with opposite view counts as farther than one 3 m away with the same view."""
    training = poses([[1, 0, 0], [3, 0, 0]], [[0, 0, np.pi], [0, 0, 0]])
    true = poses([[0, 0, 0]])
    frames = evaluation_frames("a", np.array(["a/0"]), np.array(["low"]), true, training)
    assert frames.nearest_m[0] == pytest.approx(3)
    assert frames.nearest_deg[0] == pytest.approx(0, abs=1e-9)


def test_an_empty_group_has_no_figures():
    """A group without frames raises ValueError."""
    with pytest.raises(ValueError, match="has no frames"):
        evaluate(Estimates("net", poses(np.zeros((0, 3)))), frames_of(poses(np.zeros((0, 3)))))


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.77, 1.0])
def test_quantile_is_numpys_where_all_is_finite(share):
    """For finite values the quantile equals NumPy's, for several sample sizes."""
    for n in (1, 2, 7, 20, 21):
        values = np.random.default_rng(n).normal(size=n)
        assert quantile(values, share) == pytest.approx(np.quantile(values, share))


def sampled(n, inflate=1.0, seed=0):
    """Return estimates with errors drawn from a covariance, the true poses, and that covariance.

    inflate : stated standard deviations over true ones.
    """
    rng = np.random.default_rng(seed)
    root = np.diag([0.5, 0.3, 0.8, 0.02, 0.01, 0.015])
    root[0, 4], root[2, 3] = 0.4, -0.6  # centre and rotation of a camera are correlated
    covariance = root @ root.T
    drawn = rng.normal(size=(n, 6)) @ root.T
    found = poses(rng.normal(scale=10, size=(n, 3)), rng.normal(size=(n, 3)))
    true = Poses.from_rotations(
        found.centers + drawn[:, :3], rotations_from_vectors(drawn[:, 3:]) @ found.rotations
    )
    stated = np.broadcast_to(inflate**2 * covariance, (n, 6, 6))
    return Estimates("net", found, stated), true, covariance


def test_right_covariances_are_found_right():
    """Correctly stated covariances give a ratio of 1, 0.1 % beyond, and a diagonal reliability curve."""
    estimates, true, covariance = sampled(20_000)
    one = evaluate(estimates, frames_of(true)).calibration
    # The median of chi-squared(6) at this n has a standard error of 1 %.
    assert one.ratio == pytest.approx(1, abs=0.03)
    assert one.position_ratio == pytest.approx(1, abs=0.04)
    assert one.rotation_ratio == pytest.approx(1, abs=0.04)
    assert 0.0003 < one.beyond < 0.002
    assert np.abs(np.subtract(one.observed, one.expected)).max() < 0.015
    assert one.sigma == pytest.approx(np.sqrt(np.trace(covariance[:3, :3])))
    assert one.sigma_deg == pytest.approx(np.rad2deg(np.sqrt(np.trace(covariance[3:, 3:]))))
    assert (one.frames, one.unusable, one.unknown) == (20_000, 0, 0)


@pytest.mark.parametrize(("inflate", "ratio"), [(0.5, 4.0), (2.0, 0.25)])
def test_wrong_covariances_are_found_wrong(inflate, ratio):
    """Stating half the true sigma gives a ratio of 4 and a curve below the diagonal, and vice versa."""
    estimates, true, _ = sampled(4_000, inflate)
    one = evaluate(estimates, frames_of(true)).calibration
    assert one.ratio == pytest.approx(ratio, rel=0.06)
    off = np.subtract(one.observed, one.expected)
    assert np.all(off < 0) if inflate < 1 else np.all(off > 0)


def test_the_vector_of_the_covariance_turns_the_estimate_into_the_truth():
    """e^T C^-1 e accounts for the correlation of centre and rotation with the correct sign."""
    estimates, true, _ = sampled(4_000)
    wrong = estimates.covariance.copy()
    wrong[:, :3, 3:] *= -1
    wrong[:, 3:, :3] *= -1
    flipped = evaluate(replace(estimates, covariance=wrong), frames_of(true)).calibration
    assert flipped.ratio > 1.3
    assert flipped.position_ratio == pytest.approx(1, abs=0.08)


def test_median_of_chi_squared_is_the_papers():
    """Quantiles of chi-squared equal the constants in the documentation."""
    assert chdtri(6, 0.5) == pytest.approx(5.348, abs=5e-4)
    assert chdtri(3, 0.5) == pytest.approx(2.366, abs=5e-4)
    assert chdtri(6, 0.001) == pytest.approx(22.46, abs=5e-3)


def test_covariances_that_are_none_are_counted():
    """NaN counts as unknown, a negative variance or rank below six as unusable; neither is evaluated."""
    good = np.diag([1.0, 1, 1, 1e-4, 1e-4, 1e-4])
    negative, flat = good.copy(), good.copy()
    negative[2, 2] = -1
    flat[0, 1] = flat[1, 0] = 1.0
    stated = np.stack([good, np.full((6, 6), np.nan), negative, flat])
    errors = np.tile([1.0, 0, 0, 0, 0, 0], (4, 1))
    assert is_covariance(stated).tolist() == [True, False, False, False]
    np.testing.assert_allclose(nees(errors, stated), [1, np.nan, np.nan, np.nan])
    np.testing.assert_allclose(sigmas(stated)[0], [np.sqrt(3), np.nan, np.nan, np.nan])
    one = calibrate(errors, stated)
    assert (one.frames, one.unknown, one.unusable) == (1, 1, 2)
    nothing = calibrate(errors[1:2], stated[1:2])
    assert nothing.frames == 0
    assert math.isnan(nothing.ratio)


def test_metrics_json_says_all_and_stays_json(tmp_path):
    """Infinity and NaN become null, and every method of a group and the paper's table are included."""
    estimates, true, _ = sampled(30)
    lost = replace(estimates, method="lost", poses=without_pose(estimates.poses, slice(0, 20)))
    evaluations = [evaluate(e, frames_of(true)) for e in (estimates, lost)]
    path = tmp_path / "metrics.json"
    write_metrics(
        path, evaluations, units="m", retrieval={"medium": "lost"}, facts={"seconds": np.float64(2)}
    )

    def refuse(text):
        raise AssertionError(text)

    read = json.loads(path.read_text(), parse_constant=refuse)
    assert read["version"] == 1
    assert read["units"] == "m"
    methods = read["groups"]["medium"]
    assert set(methods) == {"net", "lost"}
    assert methods["lost"]["position"]["median"] is None
    assert methods["lost"]["located"] == 10
    assert methods["net"]["position"]["median"] == evaluations[0].summary.position.median
    assert methods["net"]["calibration"]["frames"] == 30
    assert methods["net"]["curve"][0]["frames"] == 30
    assert len(read["paper"]["table_1"]) == 6
    with pytest.raises(ValueError, match="duplicate evaluation of net"):
        write_metrics(path, [evaluations[0]] * 2, units="m", retrieval={}, facts={})


def test_errors_csv_has_a_row_for_each_frame(tmp_path):
    """Cells hold errors rounded to the stated digits; unknown values are empty."""
    true = poses([[0, 0, 0], [0, 0, 10]])
    found = without_pose(poses([[3, 0, -4], [0, 0, 0]]), 1)
    write_errors(
        tmp_path / "errors.csv",
        [evaluate(Estimates("net, a", found), frames_of(true, nearest_m=[1, 2]))],
    )
    with (tmp_path / "errors.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert first["method"] == "net, a"
    assert (first["name"], first["stratum"], first["located"]) == (
        "medium/000000.jpg",
        "medium",
        "1",
    )
    assert (first["error"], first["signed_east"], first["signed_up"]) == (
        "5.0000",
        "3.0000",
        "-4.0000",
    )
    assert (first["sigma"], first["distance_sq"]) == ("", "")
    assert (second["nearest"], second["located"], second["error"]) == ("2.0000", "0", "")


def test_docs_list_what_the_files_hold(tmp_path):
    """docs/evaluation.md lists every key of metrics.json and the columns of errors.csv in order."""
    page = (Path(__file__).resolve().parents[3] / "docs" / "evaluation.md").read_text()
    json_part, csv_part = page.split("## metrics.json")[1].split("## errors.csv")
    json_part = json_part.split("### Facts")[0]  # of a run: test_evaluate.py
    estimates, true, _ = sampled(5)
    one = evaluate(estimates, frames_of(true))
    write_errors(tmp_path / "errors.csv", [one])
    columns = (tmp_path / "errors.csv").read_text().splitlines()[0].split(",")
    cells = re.findall(r"^\| (`[^|]+) \|", csv_part.split("\n##")[0], re.MULTILINE)
    assert [name for cell in cells for name in re.findall(r"`(\w+)`", cell)] == columns
    write_metrics(tmp_path / "metrics.json", [one], units="m", retrieval={}, facts={})

    def keys(value):
        if isinstance(value, dict):
            for key, part in value.items():
                yield key
                yield from keys(part)
        elif isinstance(value, list):
            for part in value:
                yield from keys(part)

    written = set(keys(json.loads((tmp_path / "metrics.json").read_text())))
    named = set(re.findall(r"`(\w+)`", json_part))
    # "fixes" is there only where a bundle was measured: tests/cli/test_cli_fixes.py.
    assert written - {"net", "medium"} == named - {"null", "m", "model", "fixes"}


def test_axes_are_named_where_the_world_has_a_place():
    """Axes are named east, north and up only if the world has an origin."""
    facts = {"units": "m", "up_is_known": True, "camera": None}
    somewhere = GeoOrigin(49.0, 8.4, 0.0, HeightReference.TAKEOFF)
    assert axes_of(DatasetInfo(origin=somewhere, **facts)) == ("east", "north", "up")
    assert axes_of(DatasetInfo(origin=None, **facts)) == ("x", "y", "z")


def test_rows_of_the_table_fit_their_header():
    """Our rows and the paper's have one cell per column, and the paper's are marked as such."""
    estimates, true, _ = sampled(30)
    evaluations = [evaluate(estimates, frames_of(true))]
    titles = header(evaluations)
    (ours,) = rows(evaluations)
    assert len(ours) == len(titles)
    assert ours[:3] == ["net", "30", "30"]
    paper = paper_rows("low", len(titles))
    assert [len(row) for row in paper] == [len(titles)] * 3
    assert paper[2][0].startswith("SqueezePoseNet (paper")
    assert (paper[2][3], paper[2][titles.index("rotation median")]) == ("15.18*", "65.02*")
    assert paper_rows("validation", len(titles)) == []
