"""Rendering is exact and free of aliasing; exposure and rolling shutter are centred on the pose."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from spn_data.geometry.camera import Camera
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.simulate import preset, simulate_paths
from spn_data.simulate.faces import Face, Texture, mirror_face
from spn_data.simulate.flight import exposure_poses
from spn_data.simulate.paths import Motion
from spn_data.simulate.place import SceneFaces, SceneOptions
from spn_data.simulate.produce import render_frame
from spn_data.simulate.render import HAZE_RGB, SceneRenderer
from spn_data.simulate.scene import build_scene, paint_all

CELLS = 16
LENSES = {
    "72 degrees": Camera.from_horizontal_fov(640, 360, 72.0, (-0.05, 0.015)),
    "94 degrees": Camera.from_horizontal_fov(640, 360, 94.0, (-0.1, 0.02, 0.003, -0.002)),
}


def plain(rgb: tuple[int, int, int]) -> Texture:
    return Texture.from_image(np.full((16, 16, 3), rgb, np.uint8))


def chessboard() -> Texture:
    cells = (np.indices((CELLS, CELLS)).sum(axis=0) % 2 * 160 + 40).astype(np.uint8)
    return Texture.from_image(np.dstack([np.kron(cells, np.ones((64, 64), np.uint8))] * 3))


def wall(texture: str, *, y: float = 8.0, half: float = 4.0) -> Face:
    """Return a square facing south, its centre one metre above the height of the origin."""
    return Face(
        texture,
        np.array([-half, y, 1 + half]),
        np.array([2 * half, 0, 0]),
        np.array([0, 0, -2 * half]),
    )


def pose(center: tuple[float, ...], angles: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    return np.array(center, dtype=np.float64), rotations_from_angles(np.array(angles, dtype=float))


def pixels_of(
    camera: Camera, center: np.ndarray, rotation: np.ndarray, points: np.ndarray
) -> np.ndarray:
    return camera.project((np.atleast_2d(points) - center) @ rotation.T)


def found_corners(image: np.ndarray, expected: np.ndarray, window: int = 4) -> np.ndarray:
    """Return chessboard corners (N, 2) near expected pixels (N, 2), in COLMAP's convention.

    The image is blurred first because the detector weighs squared gradients, which are biased by up to 0.1 px
    on edges sharper than a pixel.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.2)
    # A failed detection returns its start, so the start must differ from the answer.
    start = (expected - 0.5 + 0.6).astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    return cv2.cornerSubPix(grey, start, (window, window), (-1, -1), stop).reshape(-1, 2) + 0.5


def smoothed(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)


def wide_enough(camera: Camera, expected: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Return which corners (N,) are in the image and at least 9 px from their neighbours (N, K, 2)."""
    size = [camera.width, camera.height]
    inside = ((expected > 12) & (expected < np.array(size) - 12)).all(axis=1)
    spacing = np.linalg.norm(neighbours - expected[:, None], axis=2).min(axis=1)
    return inside & (spacing > 9)


@pytest.mark.parametrize("lens", LENSES)
def test_known_corners_appear_within_a_tenth_of_a_pixel(lens: str) -> None:
    """Chessboard corners are where Camera.project predicts, for several poses and a distorted lens."""
    camera, face = LENSES[lens], wall("board")
    renderer = SceneRenderer([face], {"board": chessboard()}, camera)
    views = [
        pose((0.3, 0, 1), (0, 0, 0)),
        pose((1.5, 1, 2), (-12, -4, 3)),
        pose((-2, 0.5, 0.5), (15, 6, -5)),
        pose((-4, 2, 0.5), (35, 3, -1)),
    ]
    grid = np.stack(np.meshgrid(np.arange(1, CELLS), np.arange(1, CELLS)), axis=-1).reshape(-1, 2)
    steps = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    errors = []
    for center, rotation in views:
        st = (grid[:, None] + steps) / CELLS  # (N, 5, 2)
        points = face.origin + st[..., :1] * face.u_edge + st[..., 1:] * face.v_edge
        pixels = pixels_of(camera, center, rotation, points.reshape(-1, 3)).reshape(-1, 5, 2)
        good = wide_enough(camera, pixels[:, 0], pixels[:, 1:])
        found = found_corners(renderer.render(center, rotation), pixels[good, 0])
        errors.append(found - pixels[good, 0])
    error = np.concatenate(errors)
    assert len(error) > 600
    assert np.linalg.norm(error, axis=1).max() < 0.1
    # A half-pixel convention error would show here; what remains is detector noise.
    assert np.abs(error.mean(axis=0)).max() < 0.005


def test_outlines_lie_within_a_fiftieth_of_a_pixel() -> None:
    """The centroid of a small bright square on a dark wall agrees with its projection to 1/50 px."""
    camera = Camera.from_horizontal_fov(640, 360, 72.0)
    square = Face(
        "white", np.array([0.2, 5, 1.6]), np.array([0.8, 0.1, 0.1]), np.array([0.1, 0, -0.7])
    )
    textures = {"white": plain((250, 250, 250)), "dark": plain((0, 0, 0))}
    renderer = SceneRenderer([wall("dark", half=40.0), square], textures, camera)
    shares = (np.arange(200) + 0.5) / 200
    s, t = (axis.reshape(-1, 1) for axis in np.meshgrid(shares, shares))
    points = square.origin + s * square.u_edge + t * square.v_edge
    for center, rotation in (pose((0.1, 0, 1), (2, 1, 7)), pose((0.33, 0.2, 1.21), (-4, -3, 21))):
        image = renderer.render(center, rotation)[:, :, 0].astype(np.float64)
        y, x = np.indices(image.shape) + 0.5
        found = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
        pixels = pixels_of(camera, center, rotation, points)
        depth = ((points - center) @ rotation.T)[:, 2]
        # Without distortion, equal areas of a plane take image areas in proportion to 1 / depth^3.
        expected = np.average(pixels, axis=0, weights=depth**-3)
        assert np.abs(found - expected).max() < 0.02


def test_nearer_faces_hide_farther_ones_and_rays_past_all_see_haze() -> None:
    """Faces occlude those behind in any list order and are visible from the front only.

    Rays that hit no face see haze.
    """
    camera = LENSES["72 degrees"]
    textures = {"near": plain((200, 0, 0)), "far": plain((0, 200, 0))}
    near, far = wall("near", y=4.0, half=0.5), wall("far", half=2.0)
    center, rotation = pose((0, 0, 1), (0, 0, 0))
    for faces in ([near, far], [far, near]):
        image = SceneRenderer(faces, textures, camera).render(center, rotation)
        assert tuple(image[180, 320]) == (200, 0, 0)
        assert tuple(image[180, 240]) == (0, 200, 0)
        assert tuple(image[5, 5]) == HAZE_RGB
    behind = pose((0, 12, 1), (180, 0, 0))
    assert (SceneRenderer([far], textures, camera).render(*behind) == HAZE_RGB).all()


def test_panes_show_the_mirror_image_of_what_lies_opposite() -> None:
    """A corner opposite a mirror appears where its mirror image projects to, from two viewpoints."""
    camera = LENSES["72 degrees"]
    mirror = wall("glass")
    board = Face("board", np.array([7.0, -6, 8]), np.array([-14.0, 0, 0]), np.array([0, 0, -14.0]))
    glass = Texture.from_image(np.full((64, 64, 4), (0, 0, 0, 255), np.uint8))
    mirror = replace(mirror, mirrored=mirror_face(board, mirror))
    renderer = SceneRenderer([mirror], {"glass": glass, "board": chessboard()}, camera)
    corner = board.origin + 0.5 * board.u_edge + 0.5 * board.v_edge
    mirrored = corner * [1, -1, 1] + [0, 2 * 8.0, 0]
    for center, rotation in (pose((0.5, 0, 1.2), (0, 0, 0)), pose((-1.5, 1, 0.4), (6, 3, 4))):
        expected = pixels_of(camera, center, rotation, mirrored)
        found = found_corners(renderer.render(center, rotation), expected)
        assert np.abs(found - expected).max() < 0.1


@pytest.fixture(scope="module")
def place() -> SceneFaces:
    return build_scene(SceneOptions(texels_per_m=60.0, seed=3))


@pytest.fixture(scope="module")
def textures(place: SceneFaces) -> dict[str, Texture]:
    return paint_all(place)


def test_survey_targets_of_the_courtyard_appear_where_they_are(
    place: SceneFaces, textures: dict[str, Texture]
) -> None:
    """Centres of the targets painted on the four facades are within 0.1 px of their projection."""
    camera = LENSES["72 degrees"]
    renderer = SceneRenderer(place.faces, textures, camera)
    for landmark, heading in zip(place.landmarks, (0, 180, 90, 270), strict=True):
        away = np.array([np.sin(np.deg2rad(heading)), np.cos(np.deg2rad(heading)), 0])
        center, rotation = pose(
            tuple(landmark - 4.0 * away + [0.3, -0.2, 0.4]), (heading - 4, -2, 3)
        )
        expected = pixels_of(camera, center, rotation, landmark)
        found = found_corners(renderer.render(center, rotation), expected, window=6)
        assert np.abs(found - expected).max() < 0.1


def test_detail_finer_than_a_pixel_turns_grey() -> None:
    """A chessboard floor with cells smaller than a pixel shows no aliasing pattern."""
    camera = Camera.from_horizontal_fov(320, 180, 30.0)
    cells = (np.indices((720, 720)).sum(axis=0) % 2 * 160 + 40).astype(np.uint8)
    board = Texture.from_image(np.dstack([np.kron(cells, np.ones((4, 4), np.uint8))] * 3))
    floor = Face(
        "board", np.array([-57.6, 57.6, 0]), np.array([115.2, 0, 0]), np.array([0, -115.2, 0])
    )
    renderer = SceneRenderer([floor], {"board": board}, camera)
    for heading in (0.0, 20.0, 45.0):
        # Cells of 0.16 m have 3 px at 32 m, and 0.6 px at 140 m.
        near = renderer.render(*pose((0.3, 0.2, 32), (heading, -89, 4)))
        assert near.std() > 50
        image = renderer.render(*pose((0.3, 0.2, 140), (heading, -89, 4))).astype(np.float64)
        assert image.mean() == pytest.approx(120, abs=1.5)
        assert image.std() < 6  # the contrast is 80 in sharp parts


def test_courtyard_is_rendered_without_aliasing(
    place: SceneFaces, textures: dict[str, Texture]
) -> None:
    """A frame differs from the area mean of a render at four times its size by at most a lens's blur."""
    camera = Camera.from_horizontal_fov(320, 180, 72.0, (-0.05, 0.015))
    fine = camera.scaled(1280, 720)
    for center, rotation in (pose((0, -9, 3), (20, 5, 0)), pose((-9, -8, 20.8), (45, -46, 0))):
        image = SceneRenderer(place.faces, textures, camera).render(center, rotation)
        reference = cv2.resize(
            SceneRenderer(place.faces, textures, fine).render(center, rotation),
            (320, 180),
            interpolation=cv2.INTER_AREA,
        )
        # Structure coarser than the grid must agree closely: aliasing is false coarse structure.
        assert np.abs(smoothed(image) - smoothed(reference)).mean() < 1.0
        assert np.abs(image.astype(float) - reference).mean() < 4.5


def test_blurred_frame_is_the_mean_of_its_exposure_about_the_true_pose(
    place: SceneFaces, textures: dict[str, Texture]
) -> None:
    """Sub-exposures are symmetric about the truth, and their sharp renders average to the frame."""
    options = replace(preset("standard"), width=320, height=180, only=("medium",))
    path = simulate_paths(options)["medium"]
    frame = int(np.flatnonzero(path.blurred)[0])
    renderer = SceneRenderer(place.faces, textures, path.camera)
    poses = exposure_poses(path, frame)
    middle = path.poses.rotations[frame]
    early, late = poses.rotations[0] @ middle.T, poses.rotations[-1] @ middle.T
    np.testing.assert_allclose(early @ late, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(poses.centers, path.poses.centers[[frame] * len(poses)])
    image = render_frame(renderer, path, frame).astype(np.float64)
    sharp = [renderer.render(c, r) for c, r in zip(poses.centers, poses.rotations, strict=True)]
    assert np.abs(smoothed(image) - smoothed(np.mean(sharp, axis=0))).mean() < 1.0
    # A sharp render at the middle pose alone differs.
    assert np.abs(image - renderer.render(path.poses.centers[frame], middle)).mean() > 3.0


def test_rolling_shutter_reads_each_row_at_its_own_time() -> None:
    """Corners appear at the time their row is read, and the truth is at the middle row."""
    options = replace(preset("standard"), width=640, height=360, blur_share=0.0, only=("medium",))
    path = simulate_paths(options)["medium"]
    time_s = np.array([-1.0, 1.0])
    centers = np.array([[-0.8, 0, 1], [1.2, 0, 1]])
    motion = Motion(time_s, centers, np.array([[-30.0, 0, 0], [30.0, 0, 0]]))
    camera = LENSES["72 degrees"]
    still = motion.poses(np.zeros(1))
    path = replace(path, camera=camera, motion=motion, time_s=np.zeros(1), poses=still)
    face = wall("board")
    readout_s = 0.03
    image = render_frame(SceneRenderer([face], {"board": chessboard()}, camera), path, 0, readout_s)
    moved = 0.0
    for s, t in ((0.5, 0.25), (0.5, 0.75), (0.25, 0.5), (0.6875, 0.6875)):
        point = face.origin + s * face.u_edge + t * face.v_edge
        start = pixel = pixels_of(camera, still.centers[0], still.rotations[0], point)
        for _ in range(10):
            at = motion.poses(np.array([(pixel[0, 1] / camera.height - 0.5) * readout_s]))
            pixel = pixels_of(camera, at.centers[0], at.rotations[0], point)
        moved = max(moved, float(np.abs(pixel - start).max()))
        assert np.abs(found_corners(image, pixel) - pixel).max() < 0.15
    assert moved > 1.5


def test_houses_leave_all_else_where_it_is() -> None:
    """Twelve houses per hectare change no other face, and each has its own part of the roof texture."""
    options = SceneOptions(texels_per_m=12.0, seed=3, area_factor=16.0)
    without, with_houses = (
        build_scene(replace(options, houses_per_hectare=n)) for n in (0.0, 12.0)
    )
    for one, other in zip(without.faces, with_houses.faces, strict=False):
        assert one.texture == other.texture
        assert np.array_equal(one.origin, other.origin)
    roofs = [face for face in with_houses.faces if face.texture == "house-roofs"]
    assert len(roofs) == round(12 * 39 * 36 * 16 / 1e4)
    assert len(with_houses.faces) == len(without.faces) + 5 * len(roofs)
    assert len({face.region for face in roofs}) == len(roofs)
    assert all(0 <= edge <= 1 for face in roofs for edge in face.region)
