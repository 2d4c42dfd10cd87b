"""Tests of frame selection: sharper than the neighbours, far enough apart, and without gaps."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from spn_data.capture.frames import FrameStatus
from spn_data.capture.measurement import (
    GrayImage,
    Measurements,
    image_sharpness,
    measure,
    relative_sharpness,
)
from spn_data.capture.photo_selection import choose_photos
from spn_data.capture.selection import (
    SelectionOptions,
    check_usable,
    choose,
    choose_all,
)
from spn_data.errors import InputError

DEFAULT = SelectionOptions()
WIDTH = 1280


def measured(
    step: np.ndarray, sharpness: np.ndarray | None = None, *, fps: float = 10.0
) -> Measurements:
    """Create N frames; before each, the image shifts sideways by `step` (N,) in fractions of the width."""
    n = len(step)
    motion = np.tile(np.eye(2, 3), (n, 1, 1))
    motion[:, 0, 2] = step
    return Measurements(
        source_idx=np.zeros(n, np.int64),
        index=np.arange(n),
        time_s=np.arange(n) / fps,
        width=np.full(n, WIDTH),
        height=np.full(n, 720),
        sharpness=np.full(n, 10.0) if sharpness is None else sharpness,
        motion=motion,
        damaged=np.zeros(n, bool),
        problem=np.full(n, "", dtype="U30"),
    )


def texture(seed: int = 3, width: int = 900, height: int = 500) -> np.ndarray:
    """Create grey noise of several scales, with detail everywhere as on grass or brick."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for cell, weight in ((2, 20), (6, 40), (20, 60)):
        coarse = rng.normal(size=(height // cell + 2, width // cell + 2))
        total += weight * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + total / 1.5, 0, 255).astype(np.uint8)


def images_of(grays: list[np.ndarray], *, fps: float = 10.0) -> list[GrayImage]:
    return [
        GrayImage(0, i, i / fps, 2 * g.shape[1], 2 * g.shape[0], g) for i, g in enumerate(grays)
    ]


def test_steady_motion_gives_frames_at_the_wanted_spacing() -> None:
    """Steady motion gives even spacing, and motion is reported in full-size pixels."""
    choice = choose(measured(np.full(400, 0.0125)), DEFAULT)
    spacing = np.diff(np.flatnonzero(choice.chosen))
    # Of equally sharp frames the first in the window is chosen, at 0.65 of the wanted 0.1.
    assert set(spacing[1:].tolist()) == {6}
    assert choice.motion_px[choice.chosen][2] == pytest.approx(6 * 0.0125 * WIDTH)
    assert choice.reason[choice.chosen][2] == "chosen: sharpest of 5 in its window"


def test_random_sharpness_spaces_frames_as_wanted_on_average() -> None:
    """Random sharpness gives the wanted spacing on average: 8 frames within 0.6."""
    rng = np.random.default_rng(1)
    choice = choose(measured(np.full(2000, 0.0125), 10 + rng.random(2000)), DEFAULT)
    assert np.diff(np.flatnonzero(choice.chosen)).mean() == pytest.approx(8, abs=0.6)


def test_blurred_frames_are_avoided_and_say_so() -> None:
    """Frames with half the sharpness of their neighbours are never chosen, and the reason says so."""
    sharpness = np.full(300, 10.0)
    sharpness[::5] = 5.0
    choice = choose(measured(np.full(300, 0.02), sharpness), DEFAULT)
    assert not choice.chosen[::5].any()
    assert choice.reason[5] == "skipped: blurred, 0.50 of its neighbours' sharpness"
    assert choice.chosen.sum() > 50


def test_a_sharp_frame_a_little_further_is_preferred_to_a_blurred_one() -> None:
    """If all frames at 0.65 to 1.35 of the wanted motion are blurred, one at 1.7 is chosen."""
    sharpness = np.full(60, 10.0)
    sharpness[24:37] = 4.0
    choice = choose(measured(np.full(60, 0.01), sharpness), replace(DEFAULT, neighbours_s=5.0))
    assert choice.chosen[21:24].any()
    assert not choice.chosen[24:37].any()
    after = np.flatnonzero(choice.chosen[37:])[0] + 37
    assert choice.reason[after].endswith("those nearer the wanted spacing are blurred")


def test_sharpness_is_judged_beside_neighbours_not_in_total() -> None:
    """A stretch with a fifth of the sharpness, such as lawn after walls, does not count as blurred."""
    sharpness = np.where(np.arange(300) < 150, 20.0, 4.0)
    data = measured(np.full(300, 0.0125), sharpness)
    relative = relative_sharpness(data, 1.0)
    assert relative[30] == relative[250] == 1.0
    chosen = choose(data, DEFAULT).chosen
    assert abs(int(chosen[:150].sum()) - int(chosen[150:].sum())) <= 3


def test_a_blurred_passage_still_gives_its_best_frames() -> None:
    """Two seconds of blur still give frames at the usual spacing, and the reason says why."""
    sharpness = np.full(200, 10.0)
    sharpness[100:108] = 3.0
    sharpness[104] = 4.0
    data = measured(np.full(200, 0.08), sharpness)
    choice = choose(data, replace(DEFAULT, neighbours_s=3.0))
    inside = np.flatnonzero(choice.chosen[100:108]) + 100
    assert len(inside) >= 1
    assert choice.reason[inside[0]].startswith("chosen: blurred (0.")
    assert "the best of" in choice.reason[inside[0]]
    assert np.diff(np.flatnonzero(choice.chosen)).max() <= 5


@pytest.mark.parametrize("seed", range(8))
def test_no_passage_is_ever_empty(seed: int) -> None:
    """Gaps never exceed max_spacing, whatever the motion, blur, breaks and damage."""
    rng = np.random.default_rng(seed)
    n = 600
    step = rng.gamma(0.3, 0.03, n) * np.repeat(rng.integers(0, 2, n // 50), 50)
    data = measured(step, rng.gamma(1.0, 5.0, n) + 0.01)
    data.motion[rng.random(n) < 0.01] = np.nan
    data.damaged[200:260] = True
    choice = choose(data, DEFAULT)
    times = data.time_s[choice.chosen]
    assert times[0] <= 1.0
    assert np.diff(times).max() <= DEFAULT.max_spacing_s + 1e-9
    assert np.diff(times).min() >= DEFAULT.min_spacing_s - 1e-9
    assert data.time_s[-1] - times[-1] <= DEFAULT.max_spacing_s
    assert all(r.startswith(s) for r, s in zip(choice.reason, choice.status, strict=True))


def test_hovering_gives_few_frames() -> None:
    """An image that only vibrates gives one frame per 2.4 to 4 seconds."""
    rng = np.random.default_rng(2)
    place = rng.normal(0, 0.01, 600)
    choice = choose(measured(np.diff(place, prepend=place[0])), DEFAULT)
    assert 60 / 4 <= choice.chosen.sum() <= 60 / 2.4
    assert "px from the previously chosen frame" in choice.reason[5]


def test_distance_by_telemetry_adds_frames_where_the_image_stands_still() -> None:
    """Telemetry adds frames if the drone moves but the image does not: every 3 m near the ground."""
    data = measured(np.zeros(400))
    track = np.column_stack([0.2 * np.arange(400), np.zeros(400), np.full(400, 5.0)])
    low = choose(data, DEFAULT, position_m=track)
    high = choose(data, DEFAULT, position_m=track + np.array([0, 0, 95]))
    none = choose(data, DEFAULT)
    assert low.chosen.sum() > 1.5 * none.chosen.sum()
    assert np.diff(track[low.chosen, 0]).max() <= 1.35 * 3.0
    assert high.chosen.sum() == none.chosen.sum()
    unknown = choose(data, DEFAULT, position_m=np.full((400, 3), np.nan))
    np.testing.assert_array_equal(unknown.chosen, none.chosen)


def test_motions_are_chained_in_order_of_time() -> None:
    """Two shifts of 0.2, the second during a 90-degree turn of the camera, add up to 0.4 of the width."""
    frames = measured(np.array([0, 0.2, 0, 0, 0]))
    frames.motion[2] = [[0, -1, 0], [1, 0, 0]]
    frames.motion[3, 1, 2] = 0.2
    frames.motion[4] = [[0, 1, 0], [-1, 0, 0]]
    choice = choose(frames, replace(DEFAULT, min_spacing_s=0.35))
    assert np.flatnonzero(choice.chosen).tolist() == [0, 4]
    assert choice.motion_px[4] == pytest.approx(0.4 * WIDTH)


def test_a_break_of_the_image_gives_a_frame_after_it() -> None:
    """After a cut the motion is unknown, so a frame is chosen soon after and has no motion."""
    data = measured(np.zeros(60))
    data.motion[30] = np.nan
    choice = choose(data, DEFAULT)
    after = np.flatnonzero(choice.chosen & (np.arange(60) >= 30))[0]
    assert after <= 33
    assert np.isnan(choice.motion_px[after])


def test_damaged_frames_are_taken_only_where_there_is_nothing_else() -> None:
    """Frames damaged by lost packets are chosen only if no other frames are available."""
    data = measured(np.full(200, 0.0125))
    data.damaged[50:53] = True
    data.damaged[100:160] = True
    choice = choose(data, DEFAULT)
    assert not choice.chosen[50:53].any()
    assert choice.reason[51] == "skipped: damaged by lost packets"
    inside = np.flatnonzero(choice.chosen[110:150]) + 110
    assert len(inside) >= 2
    assert choice.reason[inside[0]].startswith("chosen: damaged by lost packets")


def test_unreadable_frames_have_their_own_status() -> None:
    """Unreadable frames keep their problem as the reason and are excluded from the selection."""
    data = measured(np.full(40, 0.0125))
    data.problem[7] = "it is truncated"
    data.sharpness[7] = np.nan
    choice = choose(data, DEFAULT)
    assert choice.status[7] == FrameStatus.UNREADABLE
    assert choice.reason[7] == "it is truncated"
    assert (choice.status == FrameStatus.UNREADABLE).sum() == 1


@pytest.mark.parametrize("target", [20, 75, 300])
def test_a_target_count_is_met_over_all_sources(target: int) -> None:
    """Two flights together meet the target count within 5 %, each in proportion to its length."""
    rng = np.random.default_rng(4)
    flights = [measured(rng.gamma(2, 0.006, n), 10 + rng.random(n)) for n in (750, 600)]
    choices = choose_all([(f, None) for f in flights], replace(DEFAULT, target_count=target))
    counts = [int(c.chosen.sum()) for c in choices]
    assert sum(counts) == pytest.approx(target, rel=0.05)
    assert counts[0] / sum(counts) == pytest.approx(750 / 1350, abs=0.08)


def test_a_target_out_of_reach_keeps_the_shortest_spacing() -> None:
    """A target of 10,000 frames per minute is limited by the minimum spacing of 0.3 s."""
    data = measured(np.full(600, 0.02))
    [choice] = choose_all([(data, None)], replace(DEFAULT, target_count=10_000))
    assert choice.chosen.sum() == pytest.approx(600 / 3, abs=2)


def test_a_video_with_little_motion_gives_enough_frames_and_leaves_the_other_as_it_is() -> None:
    """A nearly static clip gets the minimum count without changing the choice for another flight."""
    still, moving = measured(np.full(600, 0.2 / 600)), measured(np.full(600, 0.02))
    assert choose(still, DEFAULT).chosen.sum() < DEFAULT.min_count - 5
    denser, same = choose_all([(still, None), (moving, None)], DEFAULT)
    assert denser.chosen.sum() == pytest.approx(DEFAULT.min_count, abs=2)
    assert np.array_equal(same.chosen, choose(moving, DEFAULT).chosen)


def test_photos_are_all_chosen_but_repeats() -> None:
    """A repeated photo is skipped unless telemetry shows that it was taken from elsewhere."""
    data = measured(np.array([0, 0.2, 0.001, 0.2, 0.001]))
    data.problem[3], data.sharpness[3] = "it is truncated", np.nan
    data.motion[3] = np.eye(2, 3)
    data.motion[4] = [[1, 0, 0.3], [0, 1, 0]]
    choice = choose_photos(data, DEFAULT)
    assert choice.status.tolist() == ["chosen", "chosen", "skipped", "unreadable", "chosen"]
    assert choice.reason[2] == "skipped: repeats the photo before, 1.3 px apart"
    place = np.array([[0, 0, 50], [9, 0, 50], [12, 0, 50], [15, 0, 50], [20, 0, 50]], float)
    assert choose_photos(data, DEFAULT, position_m=place).chosen[2]


def test_sharpness_falls_with_blur_and_along_one_direction_alone() -> None:
    """Motion blur along x and Gaussian blur reduce sharpness, as does detail in one direction only."""
    image = texture()
    sharp = image_sharpness(image)
    motion = image_sharpness(cv2.blur(image, (7, 1)))
    defocused = image_sharpness(cv2.GaussianBlur(image, (0, 0), 3))
    assert defocused < motion < 0.6 * sharp
    assert image_sharpness(np.full((200, 300), 90, np.uint8)) == 0
    # Stripes have no detail along their direction, so blur along it is invisible.
    assert image_sharpness(np.tile(np.array([[0, 0, 90, 90]], np.uint8), (200, 75))) == 0
    # One column brighter by 4 levels: second differences 4, -8, 4 along x, none along y.
    assert image_sharpness(np.pad([[4]], ((2, 2), (2, 2))).astype(np.uint8)) == pytest.approx(
        np.sqrt(6 * 16 * (1 + 4 + 1)) / 4 / 5
    )


def test_measured_motion_is_the_true_one() -> None:
    """The measured motion of a shifted, rotated and scaled texture is the true one."""
    big = texture(width=1100, height=800)
    center = np.array([550, 400])
    state = [
        (0, 0, 0, 1),
        (7, 0, 0, 1),
        (3, 0, 0, 1),
        (15, 0, 0, 1),
        (15, 0, 3, 1),
        (15, 0, 3, 1.05),
    ]
    grays = []
    for x, y, angle, scale in state:
        turn = cv2.getRotationMatrix2D((319.5 - x, 239.5 - y), angle, scale)
        turn[:, 2] += [x, y]
        shift = np.vstack([turn, [0, 0, 1]]) @ np.array(
            [[1, 0, 319.5 - center[0]], [0, 1, 239.5 - center[1]], [0, 0, 1]]
        )
        grays.append(cv2.warpAffine(big, shift[:2], (640, 480), flags=cv2.INTER_AREA))
    motion = measure(images_of(grays)).motion
    np.testing.assert_allclose(motion[1:4, 0, 2] * 640, [7, -4, 12], atol=0.3)
    np.testing.assert_allclose(motion[1:4, 1, 2] * 640, 0, atol=0.3)
    # OpenCV rotates counter-clockwise with y down, so the upper right element is the sine.
    np.testing.assert_allclose(np.rad2deg(motion[4, 0, 1]), 3, atol=0.1)
    np.testing.assert_allclose(np.diag(motion[5, :, :2]), 1.05, atol=0.003)


def test_motion_is_carried_past_a_frame_that_cannot_be_followed() -> None:
    """The step after one white frame covers both shifts of 6 px; a new scene gives one break."""
    big = texture()
    grays = [np.ascontiguousarray(big[:360, 6 * i : 6 * i + 640]) for i in range(12)]
    grays[5] = np.full((360, 640), 255, np.uint8)
    motion = measure(images_of(grays)).motion
    np.testing.assert_allclose(motion[5], np.eye(2, 3))
    assert motion[6, 0, 2] * 640 == pytest.approx(-12, abs=0.5)
    others = [np.ascontiguousarray(texture(9)[:360, :640])] * 8
    broken = measure(images_of(grays[:3] + others)).motion[:, 0, 2]
    assert np.isnan(broken[3:]).sum() == 1


def test_a_change_of_shape_breaks_the_motion() -> None:
    """A change of aspect ratio means another camera, so motion across it is unknown."""
    image = texture()
    motion = measure(images_of([image[:360, :640], image[:480, :640], image[:480, :640]])).motion
    assert np.isnan(motion[1]).all()
    np.testing.assert_allclose(motion[2], np.eye(2, 3), atol=1e-3)


@pytest.mark.parametrize("kind", ["black", "constant", "defocused"])
def test_a_source_without_any_sharp_frame_is_refused(kind: str) -> None:
    """Black, constant and defocused videos are refused with a one-line reason."""
    image = {
        "black": np.zeros((360, 640), np.uint8),
        "constant": np.full((360, 640), 140, np.uint8),
        "defocused": cv2.GaussianBlur(texture(), (0, 0), 20)[:360, :640],
    }[kind]
    data = measure(images_of([image] * 10))
    with pytest.raises(InputError, match=r"^flight\.mp4: every frame is blurred, dark or empty: "):
        check_usable(data, DEFAULT, "flight.mp4")


def test_a_source_with_some_sharp_frames_is_used() -> None:
    """Two sharp frames of ten are enough; if none is readable, the first problem is reported."""
    image = texture()[:360, :640]
    data = measure(images_of([cv2.GaussianBlur(image, (0, 0), 20)] * 8 + [image] * 2))
    check_usable(data, DEFAULT, "flight.mp4")
    broken = replace(data, problem=np.full(10, "it is truncated"))
    with pytest.raises(InputError, match=r"^photos: no image can be read: it is truncated$"):
        check_usable(broken, DEFAULT, "photos")
