"""Tests of novel views fused from several training images: surface, colours and camera poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_model.examples.ground import fit_level_ground
from spn_model.examples.novel_view_fusion import fused_view
from spn_model.examples.novel_views import NovelViewOptions, overhead_pose
from spn_model.examples.point_targets import Surface, SurfaceOptions, cell_centers, surface
from spn_model.examples.source_images import Occluders, SourceImages
from spn_model.examples.training_set import TrainingSet
from spn_model.models.pose_model import UNKNOWN_COUNT
from spn_model.models.scene_examples import SceneExamples, SceneStageOptions
from tests.worlds.box_world import CAMERA, SIZE_M, seen_by, write_box

CENTER, SPREAD = SIZE_M / 2, 8.0
LEVEL = SurfaceOptions(level_m=0.1)
FILL = (255, 0, 255)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> TrainingSet:
    path = write_box(tmp_path_factory.mktemp("hall") / "dataset.h5", train=24, points=500)
    with Dataset(path) as dataset:
        return TrainingSet(dataset.groups["train"])


@pytest.fixture(scope="module")
def sources(data: TrainingSet) -> SourceImages:
    return SourceImages(data, CENTER, SPREAD, 4 * SPREAD)


def above(pitch_deg: float = -60.0) -> Poses:
    """Return a pose higher than any training image of the hall, with a steeper pitch."""
    angles = rotations_from_angles(np.array([[10.0, pitch_deg, 0.0]]))
    return Poses.from_rotations([[10.0, 4.0, 8.0]], angles)


def view(data, sources, pose, *, shrink=2, surface_of=None, size=None):
    def own(row: int) -> Surface:
        return surface(
            *(data.points(row), data.poses[row : row + 1], data.intrinsics[row]),
            *(data.size, LEVEL),
        )

    return fused_view(
        data, sources, surface_of or own, pose, CAMERA.matrix, shrink, FILL, LEVEL, size
    )


def unknown_surfaces(data: TrainingSet):
    """Return empty surfaces for all training images, so that only the ground remains visible."""
    blind = np.full((90, 160), np.nan, np.float32)
    return lambda row: Surface(blind, 2, data.poses[row : row + 1], data.intrinsics[row])


def shown_by(pose: Poses, shrink: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the true reduced image (block means) and the points at its pixel centres, shape (h, w, 3)."""
    image, _ = seen_by(pose)
    height, width = (side // shrink for side in image.shape[:2])
    parts = image[: height * shrink, : width * shrink].astype(float)
    mean = parts.reshape(height, shrink, width, shrink, 3).mean(axis=(1, 3))
    lens = CAMERA.matrix[[0, 0, 1], [0, 2, 2]] / shrink
    small = replace(CAMERA, width=width, height=height, params=lens)
    return mean, seen_by(pose, small)[1]


@pytest.mark.parametrize("shrink", [1, 2, 3])
def test_a_fused_view_is_what_a_camera_there_would_see(data, sources, shrink):
    """In a view from above, the median point error is below 1 cm and colours match the truth."""
    pose = above()
    image, seen = view(data, sources, pose, shrink=shrink)
    expected, points = shown_by(pose, shrink)
    assert image.shape == expected.shape
    rows, columns = seen.inverse_depth.shape
    xyz = seen.xyz(cell_centers(columns, rows, 0.5, 1.0)).reshape(rows, columns, 3)
    known = np.isfinite(seen.inverse_depth)
    assert known.mean() > 0.8
    off = np.linalg.norm(xyz - points, axis=2)[known]
    assert np.median(off) < 0.01
    assert np.percentile(off, 90) < 0.1
    assert np.median(np.abs(image - expected).max(axis=2)[known]) < 5
    assert (image[~known] == FILL).all()


def test_a_view_may_have_another_size_than_the_training_images(data, sources):
    """The upper left part of a view, rendered as a view of its own, shows the same."""
    whole, _ = view(data, sources, above())
    part, seen = view(data, sources, above(), size=(200, 120))
    assert part.shape == (60, 100, 3)
    known = np.isfinite(seen.inverse_depth)
    assert known.mean() > 0.7
    assert np.median(np.abs(part.astype(int) - whole[:60, :100]).max(axis=2)[known]) < 5


def test_ground_is_seen_where_no_triangle_is(data, sources):
    """Without triangles, the floor is rendered at its exact height, and no wall is."""
    image, seen = view(data, sources, above(), surface_of=unknown_surfaces(data))
    known = np.isfinite(seen.inverse_depth)
    assert known.mean() > 0.5
    rows, columns = known.shape
    xyz = seen.xyz(cell_centers(columns, rows, 0.5, 1.0))[known.ravel()]
    assert np.abs(xyz[:, 2]).max() < 0.01
    expected, _ = shown_by(above(), 2)
    assert np.median(np.abs(image - expected).max(axis=2)[known]) < 20


def test_without_up_there_is_no_ground(data):
    """If the up direction is unknown, no ground is rendered."""
    image, seen = _without_up(data)
    assert np.isnan(seen.inverse_depth).all()
    assert (image == FILL).all()


def _without_up(data: TrainingSet) -> tuple[np.ndarray, Surface]:
    data.up_is_known = False
    try:
        sources = SourceImages(data, CENTER, SPREAD, 4 * SPREAD)
        assert sources.ground is None
        return view(data, sources, above(), surface_of=unknown_surfaces(data))
    finally:
        data.up_is_known = True


def test_what_two_sources_deny_is_not_painted_onto_the_ground(data, sources, monkeypatch):
    """An object without map points in one source image is not painted onto the ground."""
    pose = above()
    blind = unknown_surfaces(data)
    first = int(sources.rows[sources.best(pose, CAMERA.matrix, data.size, 16)[0]])
    plain, _ = view(data, sources, pose, surface_of=blind)
    whole = data.image
    painted = np.zeros_like(whole(first))
    painted[...] = (0, 255, 0)
    monkeypatch.setattr(data, "image", lambda row: painted if row == first else whole(row))
    misled, _ = view(data, sources, pose, surface_of=blind)
    green = (misled == [0, 255, 0]).all(axis=2)
    assert green.mean() < 0.02
    changed = (plain != misled).any(axis=2)
    assert changed.mean() > 0.02  # the source was used for the view


def test_what_a_mask_hides_is_not_drawn(data, sources, monkeypatch):
    """Masked pixels of source images do not contribute colours."""
    pose = above()
    monkeypatch.setattr(data, "valid", lambda row: np.zeros(data.size[::-1], bool))
    image, seen = view(data, sources, pose)
    assert np.isnan(seen.inverse_depth).all()
    assert (image == FILL).all()


def test_a_camera_that_sees_nothing_of_the_scene_gets_an_empty_view(data, sources):
    """A camera that sees nothing of the scene has no source images, and its view is empty."""
    away = Poses.from_rotations([[10.0, -50.0, 3.0]], rotations_from_angles([[180.0, 0.0, 0.0]]))
    assert sources.best(away, CAMERA.matrix, data.size, 16) == []
    image, seen = view(data, sources, away)
    assert np.isnan(seen.inverse_depth).all()
    assert (image == FILL).all()


def test_the_best_source_of_its_own_place_is_the_image_itself(data, sources):
    """The best source at a training pose is nearly always that image, and no source is repeated."""
    hits = 0
    for k in range(len(data)):
        best = sources.best(data.poses[k : k + 1], CAMERA.matrix, data.size, 16)
        hits += best[0] == k
        assert len(set(best)) == len(best) <= 16
    assert hits >= 20


def test_a_map_point_hides_what_lies_around_and_behind_it():
    """A map point occludes what is clearly behind it and near it in the image, and nothing else."""
    one = Occluders.from_points(np.array([[100.0, 50.0]]), np.array([5.0]), (320, 180), 6)
    at = np.array([[100.0, 50.0], [106, 50], [100, 50], [100, 50], [120, 50]])
    depth = np.array([9.0, 9, 5.2, 3, 9])
    assert one.hide(at, depth).tolist() == [True, True, False, False, False]


def facades_and_ground(rng: np.random.Generator, ground: int) -> np.ndarray:
    """Return points of four 12 m walls around a 40 m yard, and of ground at height -1.1 m.

    Ground points are only in the middle of the yard.
    """
    walls = rng.uniform([-20, -20, -0.5], [20, 20, 11], (4000, 3))
    side = rng.integers(4, size=4000)
    walls[np.arange(4000), side // 2] = np.where(side % 2, 20.0, -20.0)
    floor = rng.uniform([-12, -12, -1.15], [12, 12, -1.05], (ground, 3))
    return np.concatenate([walls, floor])


def test_ground_is_found_among_many_more_points_of_facades():
    """Ground height is found to 2 cm among facade points, and holds only near ground points."""
    found = fit_level_ground(facades_and_ground(np.random.default_rng(0), 600), 18.0)
    assert found.height == pytest.approx(-1.1, abs=0.02)
    assert found.is_at_or_below(np.array([[0, 0, -1.0], [0, 0, 0.0]])).tolist() == [True, False]
    rays = np.array([[0, 0, -1.0], [0.5, 0, -1.0], [1.85, 0, -1.0], [0, 0, 1.0], [1.0, 0, 0]])
    length = found.intersect(np.array([0.0, 0.0, 8.9]), rays)
    assert length[:2] == pytest.approx(10, abs=0.02)
    assert np.isnan(length[2:]).all()
    assert np.isnan(found.intersect(np.array([0.0, 0.0, -3.0]), rays)).all()
    assert np.abs(found.samples()[:, :2]).max() < 17


def test_a_scene_without_level_ground_has_none():
    """Facades alone, a slope and a scene of implausible size have no level ground."""
    rng = np.random.default_rng(0)
    walls = facades_and_ground(rng, 0)
    assert fit_level_ground(walls, 18.0) is None
    slope = rng.uniform(-20, 20, (5000, 3))
    slope[:, 2] = 0.3 * slope[:, 0]
    assert fit_level_ground(slope, 18.0) is None
    endless = facades_and_ground(rng, 600) * [1000, 1, 1]
    assert fit_level_ground(endless, 18.0) is None


def test_high_places_look_down_at_the_scene(data, sources):
    """Overhead cameras have no roll, stay within the options, and cover a wide range of pitches."""
    centers, scene = data.poses.centers, sources.samples
    options = NovelViewOptions(side_m=1.5, height_m=6.0)
    rng = np.random.default_rng(0)
    places = [overhead_pose(rng, centers, scene, options) for _ in range(150)]
    at = np.concatenate([place.centers for place in places])
    rotations = np.concatenate([place.rotations for place in places])
    assert at[:, 2].min() >= np.median(centers[:, 2])
    assert at[:, 2].max() <= centers[:, 2].max() + 6
    assert (at[:, :2] >= centers[:, :2].min(axis=0) - 1.5).all()
    assert np.abs(rotations[:, 0, 2]).max() < 1e-9  # no roll
    assert (rotations[:, 1, 2] <= 0).all()  # the image's upper edge is up
    assert np.linalg.det(rotations) == pytest.approx(1)
    pitch = np.degrees(np.arcsin(-rotations[:, 2, 2]))
    assert pitch.min() > 20  # below 30 if the scene has no points at steeper pitches
    assert np.histogram(pitch, [25, 50, 70, 90])[0].min() > 30


def test_a_camera_may_look_straight_down():
    """A nadir view has a valid rotation; a camera below the whole scene raises ValueError."""
    below = np.array([[3.0, 4.0, 0.0]])
    place = overhead_pose(
        np.random.default_rng(1), np.array([[3.0, 4.0, 5.0]]), below, NovelViewOptions(side_m=0.0)
    )
    assert place.rotations[0, 2] == pytest.approx([0, 0, -1])
    assert np.linalg.det(place.rotations[0]) == pytest.approx(1)
    with pytest.raises(ValueError, match="no part of the scene is below"):
        overhead_pose(np.random.default_rng(1), below, below + 50, NovelViewOptions(height_m=1.0))


def test_a_stage_begins_with_few_views(data):
    """Batches use only the first 32 views at the beginning of a stage, and all near its end."""
    options = SceneStageOptions(views_share=1.0, views=72, size_min=0.4, size_max=0.5)
    numbers: dict[float, set[int]] = {}
    for progress in (0.0, 0.5, 0.9):
        examples = SceneExamples(data, options, CENTER, SPREAD, 2, UNKNOWN_COUNT)
        drawn: list[int] = []
        examples._view = lambda n, to=drawn, of=examples: (
            to.append(n) or (data.image(0), of._surfaces.of(0))
        )
        rng = np.random.default_rng(0)
        for _ in range(8):
            examples.batch(np.arange(24), rng, progress)
        numbers[progress] = set(drawn)
    assert max(numbers[0.0]) == 31
    assert max(numbers[0.5]) == 44
    assert max(numbers[0.9]) == 71


def test_views_are_kept_within_their_memory(data, monkeypatch):
    """The number of views is reduced to fit the memory limit."""
    monkeypatch.setattr("spn_model.models.scene_examples._VIEW_BYTES", 7 * 160 * 90 * 10)
    examples = SceneExamples(
        data, SceneStageOptions(views_share=1.0), CENTER, SPREAD, 2, UNKNOWN_COUNT
    )
    assert examples._view_count == 10
    views = [examples._view(n) for n in range(10)]
    assert sum(i.nbytes + s.inverse_depth.nbytes for i, s in views) <= 7 * 160 * 90 * 10


def test_a_view_that_shows_too_little_is_the_training_image(data, monkeypatch):
    """If views show too little, the training image and its own targets are used instead."""
    monkeypatch.setattr("spn_model.models.scene_examples._LEAST_SHOWN", 1.1)
    examples = SceneExamples(
        data, SceneStageOptions(views_share=1.0), CENTER, SPREAD, 2, UNKNOWN_COUNT
    )
    assert examples._view(0) is None
    image, seen = examples._training_image(0)
    assert np.array_equal(image, data.image(0))
    assert seen is examples._surfaces.of(0)
    assert examples.held_out_views(3) is None


@pytest.mark.parametrize("shrink", [1, 2])
def test_held_out_views_are_images_of_the_data_size_with_exact_poses(data, shrink):
    """Held-out views match the true images at their poses, and none is used for training."""
    options = SceneStageOptions(views_share=1.0, views=8)
    examples = SceneExamples(data, options, CENTER, SPREAD, shrink, UNKNOWN_COUNT)
    views = examples.held_out_views(5)
    assert len(views.poses) == len(views.small) == 5
    drawn = Poses.concatenate(examples._view(n)[1].pose for n in range(8)).centers
    apart = np.linalg.norm(views.poses.centers[:, None] - drawn, axis=2)
    assert apart.min() > 0.01
    for k in range(5):
        image = views.image(k)
        assert image.shape[1::-1] == data.size
        assert np.array_equal(image[::shrink, ::shrink], views.small[k])
        assert views.intrinsics[k] == pytest.approx(CAMERA.matrix)
        true, _ = seen_by(views.poses[k : k + 1])
        off = np.abs(image.astype(float) - true).mean(axis=2)
        assert np.median(off) < 12
        wrong, _ = seen_by(views.poses[k - 1 :][:1])
        assert np.median(np.abs(image.astype(float) - wrong).mean(axis=2)) > 2 * np.median(off)
    assert (
        SceneExamples(data, SceneStageOptions(), CENTER, SPREAD, 2, UNKNOWN_COUNT).held_out_views(5)
        is None
    )


def test_shares_of_high_views_are_as_told(data):
    """The share of overhead views follows `views_high`: all of them, or none."""
    highest = data.poses.centers[:, 2].max()

    def heights(**options: float) -> np.ndarray:
        stage = SceneStageOptions(views_share=1.0, views_rise=0.0, views_side=0.0, **options)
        examples = SceneExamples(data, stage, CENTER, SPREAD, 2, UNKNOWN_COUNT)
        return np.array([examples._view(n)[1].pose.centers[0, 2] for n in range(6)])

    assert (heights(views_high=1.0, views_height=3.0) > highest).any()
    assert (heights(views_high=0.0) <= highest + 1e-6).all()


@pytest.mark.parametrize(("images", "views"), [(100, 32), (6000, 50), (UNKNOWN_COUNT, 1000)])
def test_a_short_stage_makes_few_views(data, images, views):
    """A stage makes one view per 120 images drawn, as a view takes the time of ten images."""
    examples = SceneExamples(data, SceneStageOptions(views_share=1.0), CENTER, SPREAD, 2, images)
    assert examples._view_count == views
