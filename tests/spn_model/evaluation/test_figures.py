"""Tests of evaluation figures: marks are at the correct positions and omissions are stated."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from spn_data.charts import svg
from spn_data.charts.convert import convert_figures
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_model.evaluation import figures
from spn_model.evaluation.metrics import Estimates, evaluate, evaluation_frames
from spn_model.evaluation.trajectory_view import view_matrix

SVG = "{http://www.w3.org/2000/svg}"


def level(centers):
    centers = np.asarray(centers, float)
    return Poses.from_rotations(centers, rotations_from_vectors(np.zeros_like(centers)))


TRAINING = level([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]])
TRUE = level([[2, 2, 5], [4, 2, 5], [6, 2, 5], [8, 2, 5]])


def frames(true=TRUE, group="medium", axes=("east", "north", "up")):
    n = len(true)
    names = np.array([f"{group}/{k:06d}.jpg" for k in range(n)])
    return evaluation_frames(group, names, np.full(n, "low"), true, TRAINING, axes=axes)


def shifted(by, method="net", covariance=None):
    return Estimates(method, Poses(TRUE.centers + np.array(by, float), TRUE.quats_wxyz), covariance)


def parsed(figure):
    """Return the parsed SVG tree, after checking that it has no NaN or infinity."""
    assert not re.search(r"\b(nan|inf)\b", figure, re.IGNORECASE)
    return ElementTree.fromstring(figure)


def texts(tree):
    return [node.text for node in tree.iter(f"{SVG}text")]


def circles(tree, colour):
    """Return centres, shape (N, 2), of the circles of one colour that carry a title."""
    found = [
        (float(c.get("cx")), float(c.get("cy")))
        for group in tree.iter(f"{SVG}g")
        if group.get("fill") == colour
        for c in group.iter(f"{SVG}circle")
        if c.find(f"{SVG}title") is not None
    ]
    return np.array(found).reshape(-1, 2)


def test_a_map_has_east_to_the_right_and_north_upwards():
    """The top view has east right and north up; the oblique view shows greater heights higher up."""
    np.testing.assert_allclose(view_matrix(-90, 90), [[1, 0, 0], [0, 1, 0]], atol=1e-12)
    oblique = view_matrix(-60, 25)
    np.testing.assert_allclose(oblique @ oblique.T, np.eye(2), atol=1e-12)
    assert oblique[0, 2] == pytest.approx(0)
    assert oblique[1, 2] > 0.9
    assert oblique[0, 0] > 0.8


def test_estimates_are_drawn_to_scale():
    """In the top view, equally spaced frames stay equally spaced, and offsets are drawn to scale."""
    tree = parsed(figures.trajectories(TRAINING, frames(), [shifted([0, 4, 0])]))
    drawn = circles(tree, svg.COLOURS[0])
    assert len(drawn) == 8  # four frames in two views
    above = drawn[4:]
    np.testing.assert_allclose(np.diff(above[:, 0]), np.diff(above[:, 0])[0], atol=0.11)
    assert np.ptp(above[:, 1]) < 0.11
    other = circles(
        parsed(figures.trajectories(TRAINING, frames(), [shifted([0, 6, 0])])), svg.COLOURS[0]
    )[4:]
    per_m = (above[1, 0] - above[0, 0]) / 2
    np.testing.assert_allclose((above - other)[:, 1], 2 * per_m, atol=0.2)


def test_long_coordinates_are_counted_from_a_round_number():
    """Far from zero, the drawing is the same, and axes say what has to be added to their labels."""
    by = (500_000.0, 5_400_000.0, 300.0)
    there = replace(frames(), poses=TRUE.moved_by(by), axes=("x", "y", "z"))
    one = replace(shifted([0, 4, 0]), poses=shifted([0, 4, 0]).poses.moved_by(by))
    far = parsed(figures.trajectories(TRAINING.moved_by(by), there, [one]))
    near = parsed(figures.trajectories(TRAINING, frames(), [shifted([0, 4, 0])]))
    np.testing.assert_allclose(*(circles(tree, svg.COLOURS[0]) for tree in (far, near)), atol=0.11)
    assert {"x - 500000 (m)", "y - 5400000 (m)", "z (m)"} <= set(texts(far))
    assert {"0", "10", "300"} <= set(texts(far))
    assert not any("e+" in text for text in texts(far))


def test_what_is_not_drawn_is_counted():
    """The legend counts estimates outside the plot and frames without a pose."""
    found = shifted([0, 0, 0])
    centers = found.poses.centers.copy()
    centers[0], centers[1] = 1e6, np.nan
    one = replace(found, poses=Poses(centers, found.poses.quats_wxyz))
    tree = parsed(figures.trajectories(TRAINING, frames(), [one, shifted([1, 1, 1], "other")]))
    assert "net (3 estimates, 1 outside the plot, 1 without a pose)" in texts(tree)
    assert {"other (4 estimates)", "true poses (4)", f"training cameras ({len(TRAINING)})"} <= set(
        texts(tree)
    )
    assert len(circles(tree, svg.COLOURS[0])) == 4
    # The second method has squares instead of circles, so that a figure without colours can be read.
    assert not circles(tree, svg.COLOURS[1]).size
    squares = [g for g in tree.iter(f"{SVG}g") if g.get("fill") == svg.COLOURS[1]]
    assert sum(len(g.findall(f"{SVG}path")) for g in squares) == 8 + 1  # two views and the legend


def test_names_cannot_break_out_of_a_figure():
    """Markup and control characters in names of groups, frames and methods are shown as text."""
    group = '<script>alert(1)</script>&\x01"'
    mean = shifted([0, 0, 1], method="</svg><b>")
    drawn = figures.trajectories(TRAINING, frames(group=group), [mean])
    one = evaluate(mean, frames(group=group))
    for figure in (drawn, figures.histograms([one]), figures.error_curves([one])):
        tree = parsed(figure)
        assert list(tree.iter(f"{SVG}script")) == []
        assert any("</svg><b>" in words for words in texts(tree))


def test_one_frame_can_be_drawn():
    """A single frame at a training pose with a perfect estimate can be drawn."""
    true = TRAINING[:1]
    perfect = Estimates("net", true, np.eye(6)[None])
    training = TRAINING[:1]
    one = evaluate(perfect, frames(true))
    for figure in (
        figures.trajectories(training, frames(true), [perfect]),
        figures.histograms([one]),
        figures.error_curves([one]),
        figures.calibration([one]),
    ):
        parsed(figure)


def test_nothing_with_a_pose_can_be_drawn():
    """A method without any pose has empty panels that say so."""
    lost = Estimates("lost", Poses(np.full((4, 3), np.nan), np.full((4, 4), np.nan)))
    one = evaluate(lost, frames())
    assert "lost (0 estimates, 4 without a pose)" in texts(
        parsed(figures.trajectories(TRAINING, frames(), [lost]))
    )
    words = texts(parsed(figures.histograms([one])))
    assert "4 frames: no median, 4 without a pose" in words
    curve = parsed(figures.error_curves([one]))
    assert [c for c in curve.iter(f"{SVG}circle") if c.get("r") == "3"] == []


def test_very_many_frames_are_thinned():
    """Of 5,000 frames and training cameras only a subset is drawn, and the legend says so."""
    rng = np.random.default_rng(0)
    true = level(rng.uniform(0, 10, (5000, 3)))
    some = evaluation_frames(
        "a", np.array([f"a/{k}" for k in range(5000)]), np.full(5000, ""), true, TRAINING
    )
    training = level(rng.uniform(0, 10, (5000, 3)))
    figure = figures.trajectories(training, some, [Estimates("net", true)])
    tree = parsed(figure)
    assert len(circles(tree, svg.COLOURS[0])) == 2 * 1500
    assert {"net (5000 estimates)", "true poses (1500 of 5000 drawn)"} <= set(texts(tree))
    assert len(figure) < 1e6


def bars(tree, colour):
    return [
        (float(b.get("height")), b.get("fill-opacity"))
        for b in tree.iter(f"{SVG}rect")
        if b.get("fill") == colour
    ]


def test_bars_are_as_high_as_their_counts():
    """Errors of 1, 1, 1 and 2 m give one bar three times as high as the other."""
    centers = TRUE.centers + np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 2]])
    one = evaluate(Estimates("net", Poses(centers, TRUE.quats_wxyz)), frames())
    tree = parsed(figures.histograms([one]))
    drawn = bars(tree, svg.COLOURS[0])
    assert len(drawn) == 3
    assert drawn[0][0] == pytest.approx(3 * drawn[1][0], abs=0.2)
    assert "4 frames: median 1.00 m" in texts(tree)
    assert "share of frames" in texts(tree)


def test_errors_beyond_the_scale_have_their_own_bar():
    """One outlier of 1 km among 100 frames does not stretch the scale and gets an overflow bar."""
    true = level(np.tile([[2.0, 2, 5]], (100, 1)))
    centers = true.centers + np.linspace(0.1, 2, 100)[:, None] * [1, 0, 0]
    centers[50, 0] = 1000
    one = evaluate(Estimates("net", Poses(centers, true.quats_wxyz)), frames(true))
    tree = parsed(figures.histograms([one]))
    pale = [height for height, opacity in bars(tree, svg.COLOURS[0]) if opacity == "0.4"]
    assert len(pale) == 1
    # The largest p95 is 1.9 m, the bins 0.1 m wide.
    (told,) = (words for words in texts(tree) if "beyond" in words)
    assert re.fullmatch(r"100 frames: median 1\.\d\d m, [1-9] beyond (1\.9|2)", told)


def test_limits_give_figures_of_several_groups_one_scale():
    """With given limits, groups with other errors have bars at the same place for the same error."""
    drawn = []
    for far in (1.5, 9.0):
        centers = TRUE.centers + np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, far]])
        one = evaluate(Estimates("net", Poses(centers, TRUE.quats_wxyz)), frames())
        tree = parsed(figures.histograms([one], limits=(20, 180)))
        (first, *_) = [b for b in tree.iter(f"{SVG}rect") if b.get("fill") == svg.COLOURS[0]]
        drawn.append([first.get(name) for name in ("x", "width", "height")])
    assert drawn[0] == drawn[1]


def test_trajectories_show_where_cameras_look():
    """From above, the view of a level camera that looks north is a line upwards, of truth and estimate."""
    north = Poses.from_rotations(TRUE.centers, rotations_from_angles(np.zeros((4, 3))))
    tree = parsed(figures.trajectories(TRAINING, frames(north), [Estimates("net", north)]))
    for colour in (svg.INK, svg.COLOURS[0]):
        short = [
            [tuple(map(float, end.split())) for end in step.split("L")]
            for p in tree.iter(f"{SVG}path")
            if p.get("stroke") == colour and p.get("stroke-width") == "0.9"
            for step in p.get("d")[1:].split("M")
        ]
        assert len(short) == 8  # four frames in two views
        for (x0, y0), (x1, y1) in short[4:]:
            assert x1 == pytest.approx(x0, abs=0.11)
            assert y1 < y0 - 2


def test_figures_become_png_and_pdf(tmp_path):
    """Both formats hold the drawing: its size and colours, and text as text."""
    pytest.importorskip("matplotlib")
    drawn = figures.trajectories(
        TRAINING, frames(), [shifted([0, 4, 0]), shifted([1, 1, 1], "$b_1$")]
    )
    (tmp_path / "a.svg").write_text(drawn, encoding="utf-8")
    assert convert_figures(tmp_path, ("png", "pdf")) == 2
    with Image.open(tmp_path / "a.png") as image:
        pixels = np.array(image.convert("RGB")).reshape(-1, 3)
        width, height = map(float, parsed(drawn).get("viewBox").split()[2:])
        assert image.size == pytest.approx((width * 200 / 96, height * 200 / 96), abs=2)
    for colour in svg.COLOURS[:2]:
        wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        assert (np.abs(pixels - wanted).max(axis=1) < 8).sum() > 100
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert b"/Type0" in pdf or b"/TrueType" in pdf


def test_the_oracle_lies_on_the_dashed_line():
    """Errors equal to the distance to the nearest training frame are drawn on the dashed line."""
    distance = np.array([0.25, 0.75, 1.25, 2.5, 5.0])
    true = level(np.stack([-distance, 0 * distance, 0 * distance], axis=1))
    nearest = Estimates("oracle", level(np.zeros((5, 3))))
    one = evaluate(nearest, frames(true))
    np.testing.assert_allclose(one.frames.nearest_m, distance)
    tree = parsed(figures.error_curves([one]))
    dashed = next(p for p in tree.iter(f"{SVG}path") if p.get("stroke-dasharray"))
    (x0, y0), (x1, y1) = (tuple(map(float, p.split())) for p in dashed.get("d")[1:].split("L"))
    dots = [
        (float(c.get("cx")), float(c.get("cy")))
        for c in tree.iter(f"{SVG}circle")
        if c.get("r") == "3"
    ][:4]
    for x, y in dots:
        assert y == pytest.approx(y0 + (x - x0) / (x1 - x0) * (y1 - y0), abs=0.3)


def test_right_covariances_are_drawn_on_the_diagonal():
    """Equal expected and observed shares, from 0.05 to 0.95, are drawn on the diagonal."""
    one = evaluate(shifted([0.1, 0, 0], covariance=np.tile(np.eye(6), (4, 1, 1))), frames())
    right = replace(one.calibration, observed=one.calibration.expected)
    tree = parsed(figures.calibration([replace(one, calibration=right)]))
    dots = np.array(
        [
            (float(c.get("cx")), float(c.get("cy")))
            for c in tree.iter(f"{SVG}circle")
            if c.get("r") == "2.5"
        ]
    )
    assert len(dots) == 19
    np.testing.assert_allclose(dots.sum(axis=1), dots.sum(axis=1)[0], atol=0.11)
    (curve,) = (
        p.get("d")
        for p in tree.iter(f"{SVG}path")
        if p.get("stroke") == svg.COLOURS[0] and p.get("stroke-width") == "1.5"
    )
    assert curve.count("L") == 18  # from the first to the last dot, and no further


def test_calibration_needs_a_covariance():
    """A calibration figure without any covariance raises ValueError."""
    with pytest.raises(ValueError, match="no method states a covariance"):
        figures.calibration([evaluate(shifted([1, 0, 0]), frames())])


@pytest.mark.parametrize(
    ("low", "high", "wanted"),
    [
        (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1]),
        (-3, 3, [-3, -2, -1, 0, 1, 2, 3]),
        (0.1, 0.19, [0.1, 0.12, 0.14, 0.16, 0.18]),
    ],
)
def test_ticks_are_round(low, high, wanted):
    """Ticks are multiples of 1, 2 or 5 (times a power of ten) within the range, ends included."""
    assert svg.ticks(low, high) == pytest.approx(wanted)
