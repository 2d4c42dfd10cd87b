"""Tests of coverage: nearest frames, strata, view shares, and reflight planning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.coverage.nearest_frame import (
    CoverageOptions,
    Stratum,
    coverage_strata,
    height_outside_range,
    nearest_frames,
)
from spn_data.coverage.refly import ReflyOptions, _costs, plan_reflight, reach_notes
from spn_data.coverage.sequence_table import (
    COLUMNS,
    MappingFrames,
    Queries,
    assess_coverage,
    coverage_notes,
    write_coverage,
)
from spn_data.coverage.view_share import SeenMap, ViewShareOptions, view_shares
from spn_data.dataset.cambridge import read_cambridge
from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.simulate import preset, simulate_paths

CAMERA = Camera.from_horizontal_fov(1600, 900, 90.0)
NORTH = (0.0, 0.0, 0.0)


def looking(*rows: tuple[float, ...]) -> Poses:
    """Return poses of rows (x, y, z, heading, pitch, roll), with omitted angles set to 0."""
    full = np.array([(*row, *NORTH)[:6] for row in rows], dtype=np.float64)
    return Poses.from_rotations(full[:, :3], rotations_from_angles(full[:, 3:]))


def both(a: Poses, b: Poses) -> Poses:
    return Poses(
        np.concatenate([a.centers, b.centers]), np.concatenate([a.quats_wxyz, b.quats_wxyz])
    )


@pytest.fixture(scope="module")
def flights() -> dict[int, tuple[Poses, dict[str, Poses]]]:
    """Return by seed every eighth mapping pose and the poses of the evaluation flights."""
    found = {}
    for seed in (1, 2, 3):
        paths = simulate_paths(preset("standard", seed=seed))
        mapping = [path.poses[::8] for path in paths.values() if path.role == "mapping"]
        evaluation = {name: paths[name].poses for name in ("medium", "low")}
        found[seed] = (both(*mapping), evaluation)
    return found


class TestNearest:
    def test_strata_end_at_their_limits(self):
        """High ends at 2 m and 15 degrees, medium at 5 m and 40 degrees; both limits must hold."""
        queries = looking(
            (2, 0, 0), (2.001, 0, 0), (0, 0, 0, 14.999), (0, 0, 0, 15.001),
            (5, 0, 0), (5.001, 0, 0), (0, 0, 0, 39.999), (0, 0, 0, 40.001),
            (0, 0, 4.9, 0, -39.9), (0, 0, 1, 0, 0, 41),
        )  # fmt: skip
        expected = ["high", *["medium", "high", "medium"], *["medium", "low"] * 3]
        assert coverage_strata(queries, looking((0, 0, 0))).tolist() == expected

    def test_the_limits_are_options(self):
        """Other limits give other strata."""
        options = CoverageOptions(high_m=3.0, high_deg=20.0, medium_m=3.5, medium_deg=20.0)
        found = coverage_strata(
            looking((2.9, 0, 0), (3.4, 0, 0), (3.6, 0, 0)), looking(NORTH), options
        )
        assert found.tolist() == ["high", "medium", "low"]

    def test_limits_of_high_lie_within_those_of_medium(self):
        """Limits of high that exceed those of medium are refused."""
        with pytest.raises(ValueError, match="within those of medium"):
            CoverageOptions(high_m=6.0)

    def test_near_and_looking_elsewhere_is_not_near(self):
        """A frame at the same place that looks the opposite way is not the nearest."""
        mapping = looking((0, 0, 0, 180), (3, 0, 1, 10))
        found = nearest_frames(looking((0, 0, 0)), mapping)
        assert found.frame.tolist() == [1]
        assert found.stratum.tolist() == ["medium"]
        assert found.distance[0] == pytest.approx(np.sqrt(10))
        assert found.angle_deg[0] == pytest.approx(10)
        assert found.height[0] == pytest.approx(-1)  # the query is 1 m below the frame

    def test_the_better_stratum_counts_before_the_smaller_sum(self):
        """The better stratum takes precedence over the smaller sum of distance and angle."""
        found = nearest_frames(looking((0, 0, 0)), looking((1.9, 0, 0, 14), (0.1, 0, 0, 16)))
        assert found.stratum.tolist() == ["high"]
        assert found.frame.tolist() == [0]
        assert found.answer_distance[0] == pytest.approx(0.1)
        assert found.answer_angle_deg[0] == pytest.approx(16)

    def test_q_and_minus_q_are_one_direction(self):
        """Quaternions q and -q give the same angle."""
        mapping = looking((0, 0, 0, 170))
        turned = Poses(mapping.centers, -mapping.quats_wxyz)
        assert nearest_frames(mapping, turned).angle_deg[0] < 1e-6

    def test_blocks_change_nothing(self, monkeypatch):
        """Comparing frames in blocks of bounded memory does not change the result."""
        rng = np.random.default_rng(0)
        rows = rng.uniform((-20, -20, 0, 0, -40, 0), (20, 20, 10, 360, 10, 0.1), (300, 6))
        queries, mapping = looking(*rows[:120]), looking(*rows[120:])
        whole = nearest_frames(queries, mapping)
        monkeypatch.setattr("spn_data.coverage.nearest_frame._PAIRS_AT_ONCE", 1000)
        parts = nearest_frames(queries, mapping)
        for column in ("stratum", "frame", "distance", "answer_distance", "answer_angle_deg"):
            np.testing.assert_array_equal(getattr(whole, column), getattr(parts, column))
        assert set(whole.stratum) == {"medium", "low"} or set(whole.stratum) == {*Stratum}

    def test_frames_without_a_pose_have_no_stratum_and_cover_nothing(self):
        """A query without pose has stratum ""; a mapping frame without pose is ignored."""
        queries, mapping = looking((1, 0, 0), (9, 0, 0)), looking((0, 0, 0), (9, 0, 0))
        queries.centers[0], queries.quats_wxyz[0] = np.nan, np.nan
        mapping.centers[1], mapping.quats_wxyz[1] = np.nan, np.nan
        assert coverage_strata(queries, mapping).tolist() == ["", "low"]

    def test_without_mapping_frames_there_is_no_answer(self):
        """A map without frames raises GeometryError."""
        with pytest.raises(GeometryError, match="no mapping frame"):
            nearest_frames(looking((0, 0, 0)), looking((0, 0, 0))[:0])

    def test_no_query_has_no_coverage(self):
        """An empty sequence gives empty columns."""
        assert len(nearest_frames(looking((0, 0, 0))[:0], looking((0, 0, 0)))) == 0

    def test_heights_beyond_the_mapping_frames(self):
        """Heights above the highest mapping frame are positive, below the lowest negative, else zero."""
        found = height_outside_range(np.array([-1.0, 2.0, 5.0, 8.5]), np.array([2.0, 7.0, 3.0]))
        assert found.tolist() == [-3.0, 0.0, 0.0, 1.5]

    def test_the_best_answer_on_shop_facade(self, shared_data):
        """ShopFacade's medians are 0.75 m and 8.5 degrees, with 90 % within 2 m and 20 degrees."""
        lists = [
            read_cambridge(shared_data / "cambridge" / "ShopFacade" / f"dataset_{part}.txt")
            for part in ("train", "test")
        ]
        assert [len(found) for found in lists] == [231, 103]
        options = CoverageOptions(high_deg=20.0)
        found = nearest_frames(lists[1].poses, lists[0].poses, options)
        assert np.median(found.answer_distance) == pytest.approx(0.746, abs=0.001)
        assert np.median(found.answer_angle_deg) == pytest.approx(8.477, abs=0.001)
        assert np.mean(found.stratum == Stratum.HIGH) == pytest.approx(0.903, abs=0.001)

    def test_simulated_flights_are_what_their_names_say(self, flights):
        """`medium` is mostly within 5 m and 40 degrees; `low` never is, and flies above the map."""
        for mapping, evaluation in flights.values():
            medium = coverage_strata(evaluation["medium"], mapping)
            assert np.mean(medium != Stratum.LOW) > 0.7
            low = evaluation["low"]
            assert set(coverage_strata(low, mapping).tolist()) == {Stratum.LOW.value}
            above = height_outside_range(low.centers[:, 2], mapping.centers[:, 2])
            assert above.min() > 2.0


def wall(y: float, step: float = 0.25, half: float = 6.0) -> np.ndarray:
    """Return points of an upright wall facing south, dense enough to fill every cell 5 m away."""
    x, z = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1)


def seen_from(xyz: np.ndarray, *centers: tuple[float, float, float]) -> SeenMap:
    """Return a map in which all points are seen from each of the centres."""
    places, points = np.array(centers, dtype=np.float64), np.arange(len(xyz))
    return SeenMap.build(
        xyz,
        places,
        np.repeat(np.arange(len(places)), len(xyz)),
        np.tile(points, len(places)),
    )


class TestViews:
    def test_a_wall_that_fills_the_view_is_covered(self):
        """A wall seen from nearby covers the whole view; half a wall covers half of it."""
        here = looking((0, 0, 0))
        assert view_shares(here, [CAMERA], seen_from(wall(5), (0.3, 0, 0)))[0] == 1.0
        right = wall(5)[wall(5)[:, 0] > 0]
        assert view_shares(here, [CAMERA], seen_from(right, (0.3, 0, 0)))[0] == 0.5

    def test_behind_the_camera_there_is_nothing(self):
        """Points behind the camera, and a map without points, cover nothing."""
        south = looking((0, 0, 0, 180))
        assert view_shares(south, [CAMERA], seen_from(wall(5), (0, 0, 0)))[0] == 0.0
        assert view_shares(south, [CAMERA], seen_from(wall(5)[:0], (0, 0, 0)))[0] == 0.0

    @pytest.mark.parametrize(("turn_deg", "share"), [(38.0, 1), (42.0, 0)])
    def test_points_seen_from_another_side_do_not_count(self, turn_deg, share):
        """A point counts if it was seen from 38 degrees to the side, but not from 42 degrees."""
        point = np.array([[0.0, 10.0, 0.0]])
        angle = np.deg2rad(turn_deg)
        aside = (10 * np.sin(angle), 10 - 10 * np.cos(angle), 0.0)
        found = view_shares(looking((0, 0, 0)), [CAMERA], seen_from(point, aside))
        assert found[0] * 16 * 9 == pytest.approx(share)

    @pytest.mark.parametrize(
        ("range_m", "share"), [(4.9, 0), (5.1, 1), (10.0, 1), (19.9, 1), (20.1, 0)]
    )
    def test_points_seen_from_another_distance_do_not_count(self, range_m, share):
        """A point at 10 m counts if it was seen from between half and twice that distance."""
        point = np.array([[0.0, 10.0, 0.0]])
        found = view_shares(looking((0, 0, 0)), [CAMERA], seen_from(point, (0, 10 - range_m, 0)))
        assert found[0] * 16 * 9 == pytest.approx(share)

    def test_one_of_several_sightings_is_enough(self):
        """One mapping frame similar in direction and distance is enough for a point to count."""
        point = np.array([[0.0, 10.0, 0.0]])
        frames = [(40.0, 10.0, 0.0), (0.0, 30.0, 0.0), (0.5, 1.0, 0.0)]
        found = view_shares(looking((0, 0, 0)), [CAMERA], seen_from(point, *frames))
        assert found[0] > 0

    def test_points_behind_a_wall_do_not_count(self):
        """Points behind a nearer wall are occluded, and the wall was not seen from nearby."""
        beyond = wall(20, half=18)
        near = wall(5)
        xyz = np.concatenate([near, beyond])
        frames = np.array([[0.0, 8.0, 0.0]])  # between both walls
        rows = np.arange(len(near), len(xyz))
        seen = SeenMap.build(xyz, frames, np.zeros(len(rows), np.int64), rows)
        assert view_shares(looking((0, 0, 0)), [CAMERA], seen)[0] == 0.0
        open_view = SeenMap.build(beyond, frames, np.zeros(len(rows), np.int64), rows - len(near))
        assert view_shares(looking((0, 0, 0)), [CAMERA], open_view)[0] > 0.9

    def test_two_stray_points_hide_nothing(self):
        """Two wrong points in a cell do not occlude the points behind them."""
        beyond = wall(20, half=21)
        stray = np.repeat([[0.1, 1.0, 0.1]], 2, axis=0)
        for count, share in ((2, 1.0), (3, None)):
            xyz = np.concatenate([beyond, np.repeat(stray[:1], count, axis=0)])
            found = view_shares(
                looking((0, 0, 0)),
                [CAMERA],
                SeenMap.build(
                    xyz, np.zeros((1, 3)), np.zeros(len(beyond), int), np.arange(len(beyond))
                ),
                ViewShareOptions(columns=8, rows=4),
            )
            assert found[0] == (share if share else pytest.approx(1.0, abs=0.04))

    def test_a_lens_that_folds_back_shows_no_ghosts(self):
        """Points that a strong distortion polynomial folds back into the image are not in view."""
        lens = Camera("SIMPLE_RADIAL", 1600, 900, np.array([800.0, 800.0, 450.0, -0.15]))
        ghost = np.array([[2.6, 1.0, 0.0]])  # 69 degrees off axis; the image ends at about 50
        pixel = lens.project(ghost @ looking((0, 0, 0)).rotations[0].T)[0]
        assert 0 <= pixel[0] < 1600
        assert 0 <= pixel[1] < 900
        seen = seen_from(ghost, (0, 0, 0))
        assert view_shares(looking((0, 0, 0)), [lens], seen)[0] == 0.0

    def test_each_pose_has_its_own_camera(self):
        """A narrow camera is fully covered by a small wall, but a wide one is not."""
        narrow = Camera.from_horizontal_fov(1600, 900, 30.0)
        here = looking((0, 0, 0), (0, 0, 0))
        found = view_shares(here, [CAMERA, narrow], seen_from(wall(5, 0.1, half=1.5), (0, 0, 0)))
        assert found[0] < 0.3
        assert found[1] == 1.0

    def test_sightings_of_frames_without_a_pose_do_not_count(self):
        """Sightings from a frame without a centre are ignored."""
        point = np.array([[0.0, 10.0, 0.0]])
        seen = SeenMap.build(point, np.full((1, 3), np.nan), np.zeros(1, int), np.zeros(1, int))
        assert view_shares(looking((0, 0, 0)), [CAMERA], seen)[0] == 0.0

    def test_what_is_skipped_for_speed_changes_nothing(self, monkeypatch):
        """Shares are the same without the shortcuts that skip blocks and points."""
        rng = np.random.default_rng(4)
        xyz = np.concatenate([wall(9, 0.6, 12), rng.uniform(-15, 15, (3000, 3))])
        frames = rng.uniform(-8, 8, (40, 3))
        sightings = rng.integers(0, 40, 9000), rng.integers(0, len(xyz), 9000)
        rows = rng.uniform((-9, -9, -2, 0, -80, -20), (9, 9, 9, 360, 30, 20), (40, 6))
        poses = looking(*rows)
        quick = view_shares(poses, [CAMERA] * 40, SeenMap.build(xyz, frames, *sightings))
        monkeypatch.setattr("spn_data.coverage.view_share._BLOCK", 10_000)
        monkeypatch.setattr("spn_data.coverage.view_share._FIRST", 10_000)
        slow = view_shares(poses, [CAMERA] * 40, SeenMap.build(xyz, frames, *sightings))
        np.testing.assert_array_equal(quick, slow)
        assert 0.1 < quick.mean() < 0.9


class TestReflightPlan:
    @pytest.mark.parametrize("wanted", [Stratum.HIGH, Stratum.MEDIUM])
    def test_frames_at_the_stops_close_all_gaps(self, flights, wanted):
        """With mapping frames added at the stops, all frames reach the wanted stratum."""
        enough = {"high"} if wanted is Stratum.HIGH else {"high", "medium"}
        for mapping, evaluation in flights.values():
            queries = both(evaluation["medium"], evaluation["low"])
            before = coverage_strata(queries, mapping)
            needy = ~np.isin(before, list(enough))
            found = plan_reflight(queries, before, refly=ReflyOptions(wanted=wanted))
            after = coverage_strata(queries, both(mapping, found.poses))
            assert set(after.tolist()) <= enough
            assert needy.sum() > 200
            assert len(found) < needy.sum() / 5
            assert found.serves.sum() == needy.sum()
            assert (found.serves > 0).all()
            np.testing.assert_array_equal(found.query_stop >= 0, needy)

    def test_the_margin_is_kept(self, flights):
        """Each frame is within 0.7 of the limits of the stop that serves it."""
        mapping, evaluation = flights[1]
        queries = evaluation["low"]
        found = plan_reflight(queries, coverage_strata(queries, mapping))
        options = CoverageOptions(high_m=1.4001, high_deg=10.501)
        served = found.poses[found.query_stop]
        for k in range(len(queries)):
            assert coverage_strata(queries[k : k + 1], served[k : k + 1], options)[0] == "high"

    def test_one_stop_serves_a_cluster(self):
        """Ten frames within half a metre need one stop; one far away needs its own."""
        rows = [(0.05 * k, 0.0, 3.0, 90.0 + 0.2 * k, -10.0) for k in range(10)]
        queries = looking(*rows, (30, 0, 3, 90, -10))
        found = plan_reflight(queries, np.full(11, "low"))
        assert sorted(found.serves.tolist()) == [1, 10]
        np.testing.assert_allclose(found.angles_deg[:, 1:], [[-10, 0]] * 2, atol=1e-9)

    def test_stops_that_became_superfluous_are_left_out(self):
        """The middle stop, chosen first, is dropped when its neighbours make it redundant."""
        queries = looking(*[(x, 0, 3) for x in (0.0, -1.3, 1.3, -0.9, 0.9, -2.5, 2.5)])
        found = plan_reflight(queries, np.full(7, "low"))
        assert sorted(found.poses.centers[:, 0].tolist()) == [-1.3, 1.3]

    def test_turning_costs_by_degrees_per_metre(self):
        """At 10 degrees per metre, a move of 3 m and 20 degrees costs 5 m."""
        there = looking((3, 0, 0, 20, 0, 0))
        assert _costs(looking((0, 0, 0)), there, 10.0)[0, 0] == pytest.approx(5.0)

    def test_what_is_covered_needs_no_stop(self):
        """Frames that already have the wanted stratum need no stop."""
        found = plan_reflight(looking((0, 0, 0), (50, 0, 0)), np.array(["high", "high"]))
        assert len(found) == 0
        assert found.query_stop.tolist() == [-1, -1]

    def test_a_camera_is_level_unless_the_frame_is_much_rolled(self):
        """A roll of 2 degrees is set to zero; one of 90 degrees (an upright phone) is kept."""
        queries = looking((0, 0, 0, 10, -5, 2), (20, 0, 0, 10, -5, 90))
        found = plan_reflight(queries, np.array(["low", "low"]))
        assert sorted(np.round(found.angles_deg[:, 2], 6).tolist()) == [0.0, 90.0]
        assert set(coverage_strata(queries, found.poses).tolist()) == {"high"}

    def test_no_place_is_near_the_ground_or_an_obstacle(self):
        """Stops are raised to the floor and out of a hedge; a frame under a roof has none, which is said."""
        rng = np.random.default_rng(0)
        ground = np.column_stack([rng.uniform(-9, 60, (6000, 2)), np.zeros(6000)])
        hedge = rng.uniform((18, -1, 0), (22, 1, 2.2), (900, 3))
        roof = rng.uniform((38, -2, 3.0), (42, 2, 3.1), (900, 3))
        queries, strata = looking((0, 0, 1.1), (20, 0, 2.0), (40, 0, 1.1)), np.full(3, "low")
        points = np.vstack([ground, hedge, roof])
        found = plan_reflight(queries, strata, map_xyz=points)
        assert found.query_stop.tolist()[2] == -1
        assert found.out_of_reach == 1
        heights = found.poses.centers[found.query_stop[:2], 2]
        assert heights[0] == pytest.approx(2.0)
        assert 3.0 < heights[1] <= 2.0 + 0.7 * 2
        free = plan_reflight(queries, strata)
        assert sorted(free.poses.centers[:, 2]) == [1.1, 1.1, 2.0]
        (said,) = reach_notes(found, ReflyOptions())
        assert said.startswith(
            "1 frames would need a place to fly again that is less than 2 m above"
        )

    def test_the_order_is_a_short_path(self):
        """Stops along a shuffled line are ordered from one end to the other."""
        order = np.random.default_rng(3).permutation(30)
        queries = looking(*[(5.0 * k, 0.0, 3.0) for k in order])
        found = plan_reflight(queries, np.full(30, "low"))
        steps = np.diff(found.poses.centers[:, 0])
        np.testing.assert_allclose(np.abs(steps), 5.0)
        assert len(set(np.sign(steps))) == 1

    def test_the_path_is_shorter_than_by_the_nearest_next_stop(self, monkeypatch):
        """Reversing stretches of the path makes it 10 % shorter than the greedy order."""
        rng = np.random.default_rng(2)
        queries = looking(*np.column_stack([rng.uniform(0, 80, (60, 2)), np.full(60, 5.0)]))
        ways = []
        for limit in (400, 0):
            monkeypatch.setattr("spn_data.coverage.refly._MAX_SHORTENED", limit)
            centers = plan_reflight(queries, np.full(60, "low")).poses.centers
            ways.append(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
        assert ways[0] < 0.9 * ways[1]

    def test_crossing_paths_are_untangled(self):
        """On a loop of stops, the path is no longer than the loop."""
        angle = np.linspace(0, 2 * np.pi, 41)[:-1]
        rng = np.random.default_rng(0)
        radius = 20 + rng.uniform(-1.5, 1.5, 40)
        rows = [(r * np.sin(a), r * np.cos(a), 5.0) for r, a in zip(radius, angle, strict=True)]
        found = plan_reflight(looking(*rows), np.full(40, "low"))
        flown = np.linalg.norm(np.diff(found.poses.centers, axis=0), axis=1).sum()
        loop = np.linalg.norm(np.diff(np.array(rows), axis=0), axis=1).sum()
        assert flown <= loop * 1.001


class TestTable:
    def table(self, *, has_up: bool = True, options: CoverageOptions | None = None):
        queries = looking((0, 0, 0), (1, 0, 4), (9, 0, 0))
        queries.centers[2], queries.quats_wxyz[2] = np.nan, np.nan
        mapping = MappingFrames(
            np.array(["a/1.jpg", "a/2.jpg"]),
            looking((0, 0, -1), (1, 0, 1)),
            seen_from(wall(5), (0, 0, 0)),
            has_up,
        )
        names, reason = np.array(["e/1.jpg", "e/2.jpg", "e/3.jpg"]), np.array(["", "", "ambiguous"])
        return assess_coverage(Queries(names, queries, [CAMERA] * 3, reason), mapping, options)

    def test_failed_frames_are_counted_and_have_a_row(self, tmp_path):
        """A failed frame is counted and gets a row, but does not enter the medians."""
        found = self.table(options=CoverageOptions())
        summary = found.summary()
        assert (summary["frames"], summary["failed"]) == (3, 1)
        assert summary["strata"] == {"high": 1, "medium": 1, "low": 0}
        assert summary["median"]["distance"] == pytest.approx((1 + 3) / 2)
        write_coverage(tmp_path / "c.csv", found)
        rows = [line.split(",") for line in (tmp_path / "c.csv").read_text().splitlines()]
        assert tuple(rows[0]) == COLUMNS
        expected = "e/1.jpg,registered,high,a/1.jpg,1.0000,0.000,1.0000,0.0000"
        assert ",".join(rows[1][:8]) == expected
        assert rows[3] == ["e/3.jpg", "failed", *[""] * (len(COLUMNS) - 3), "ambiguous"]

    def test_heights_that_were_never_mapped_are_reported(self):
        """The note gives the number of frames above the mapping frames and by how much."""
        sentences = coverage_notes("e", self.table(options=CoverageOptions()))
        assert any("1 of 3 frames failed" in s for s in sentences)
        assert any(
            "1 of 2 are above the highest mapping frame, by up to 3.0 m" in s for s in sentences
        )

    def test_without_metres_there_are_no_strata_and_no_heights(self):
        """In model units, distances are given but strata and heights are unknown."""
        found = self.table(has_up=False)
        assert set(found.stratum.tolist()) == {""}
        assert np.isnan(found.height).all()
        assert found.distance[1] == pytest.approx(3)
        assert found.summary()["heights"] is None
        assert not any("are above" in s for s in coverage_notes("e", found))

    def test_a_plan_of_another_place_is_reported(self):
        """Frames kilometres away from the map are reported."""
        found = self.table(options=CoverageOptions())
        far = replace(found, distance=found.distance + 7000.0)
        assert any("7 km away" in s for s in coverage_notes("e", far))
