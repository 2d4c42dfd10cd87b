"""Each place has exact truth and differs from seed to seed; what moves and shines is no part of the truth."""

from __future__ import annotations

import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from spn_cli.data import main

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.simulate import (
    PRESETS,
    LensOptions,
    MappingPaths,
    SimulateOptions,
    preset,
    simulate_paths,
    simulate_telemetry,
)
from spn_data.simulate.bodies import Ride, Sway
from spn_data.simulate.faces import Face, Texture
from spn_data.simulate.light import GAIN_UNIT, LightOptions, Sunlight, cast_shadows
from spn_data.simulate.place import SceneFaces
from spn_data.simulate.produce import render_frame
from spn_data.simulate.render import SceneRenderer
from spn_data.simulate.scene import build_scene, paint, paint_all
from spn_data.simulate.srt import srt_text

PLACES = ("look-alike", "modern", "street", "village")
# The largest horizontal face of each place.
GROUND = {"look-alike": "plaza", "modern": "plaza", "street": "road", "village": "ground"}


def tiny(name: str, seed: int = 11) -> SimulateOptions:
    """Return options that are quick to paint and render."""
    return replace(
        preset(name, seed=seed),
        width=160,
        height=90,
        fps=2.0,
        length_factor=0.03,
        texels_per_m=16.0,
        area_factor=0.2 if name == "village" else 1.0,
    )


def flat(scene: SceneFaces, **colours: tuple[int, int, int]) -> dict[str, Texture]:
    """Return textures of one colour each: black, or as given for those whose name begins so."""
    textures = {}
    for name in scene.canvases:
        colour = next((c for start, c in colours.items() if name.startswith(start)), (0, 0, 0))
        textures[name] = Texture.from_image(np.full((8, 8, 3), colour, np.uint8))
    return textures


@pytest.fixture(scope="module")
def scenes() -> dict[str, SceneFaces]:
    """Scene of each place with seed 11."""
    return {name: build_scene(tiny(name).scene) for name in PLACES}


# Checksum of the telemetry, and mean grey levels of 2 x 4 parts of the second frame, before there were other
# places. Rounding differs between processors and versions of OpenCV by less than 0.1.
STANDARD = {
    "flight1": (3741125860, [[115.93, 116.3, 119.73, 119.51], [96.22, 107.83, 97.41, 102.13]]),
    "flight2": (2066893190, [[106.11, 112.17, 113.37, 115.84], [92.85, 108.83, 96.21, 104.34]]),
    "medium": (1969698348, [[103.13, 106.24, 102.55, 106.54], [115.01, 102.35, 98.13, 90.52]]),
    "low": (2147202045, [[103.88, 110.76, 116.69, 108.2], [115.28, 129.35, 104.3, 111.42]]),
}


def test_standard_is_what_it_was() -> None:
    """Telemetry and frames of `standard` and the telemetry of `demo` are those of earlier versions."""
    options = tiny("standard")
    scene = build_scene(options.scene)
    textures = paint_all(scene)
    for name, (checksum, grey) in STANDARD.items():
        path = simulate_paths(options)[name]
        text = srt_text(simulate_telemetry(path, options), options.fps)
        assert zlib.crc32(text.encode()) == checksum
        image = render_frame(SceneRenderer(scene.faces, textures, path.camera), path, 1)
        parts = cv2.resize(image.astype(np.float64), (4, 2), interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(parts.mean(axis=2), grey, rtol=0, atol=0.1)
    demo = tiny("demo")
    for name, path in simulate_paths(demo).items():
        text = srt_text(simulate_telemetry(path, demo), demo.fps)
        assert zlib.crc32(text.encode()) == STANDARD[name][0]


def test_command_offers_every_preset() -> None:
    """`spn-data simulate --preset` lists exactly the presets there are."""
    option = next(o for o in main.commands["simulate"].params if o.name == "preset")  # type: ignore[attr-defined]
    assert sorted(option.type.choices) == sorted(PRESETS)


@pytest.mark.parametrize("name", ["modern", "street", "village"])
def test_ground_seen_in_one_frame_is_where_the_truth_says_in_another(
    name: str, scenes: dict[str, SceneFaces]
) -> None:
    """A pattern on the ground, located through one frame's exact pose, is the same in another frame."""
    scene, ground = scenes[name], GROUND[name]
    face = next(face for face in scene.faces if face.texture == ground)
    textures = flat(scene)
    rng = np.random.default_rng(3)
    cells = rng.choice(np.array([90, 250], np.uint8), (24, 24))
    pattern = np.kron(cells, np.ones((32, 32), np.uint8))
    textures[ground] = Texture.from_image(np.dstack([pattern] * 3))
    options = replace(tiny(name), width=320, height=180, length_factor=1.0, light=LightOptions())
    agree, compared = 0, 0
    paths = list(simulate_paths(options).values())
    for path in (paths[1], paths[3]):  # one for mapping and one that looks down
        renderer = SceneRenderer(scene.faces, textures, path.camera)
        sharp = replace(path, blurred=np.zeros_like(path.blurred))
        for first in len(path.time_s) * np.arange(1, 3) // 3:
            one, other = (render_frame(renderer, sharp, i)[:, :, 0] for i in (first, first + 2))
            y, x = np.nonzero(one > 60)
            if not len(x):
                continue
            rays = path.camera.unproject(np.stack([x, y], axis=1) + 0.5)
            directions = np.column_stack([rays, np.ones(len(rays))]) @ path.poses.rotations[first]
            center = path.poses.centers[first]
            depth = (face.origin[2] - center[2]) / directions[:, 2]
            points = center + depth[:, None] * directions
            turned = points - path.poses.centers[first + 2]
            pixels = path.camera.project(turned @ path.poses.rotations[first + 2].T)
            inside = (np.abs(np.nan_to_num(pixels, nan=-9.0) - [160, 90]) < [158, 88]).all(axis=1)
            column, row = pixels[inside].astype(int).T
            # The rest is hidden by something black in the other frame.
            seen = other[row, column] > 60
            difference = other[row, column].astype(int) - one[y, x][inside]
            agree += int((np.abs(difference[seen]) < 60).sum())
            compared += int(seen.sum())
    assert compared > 1000
    assert agree > 0.95 * compared


@pytest.mark.parametrize("name", PLACES)
def test_seeds_differ(name: str, scenes: dict[str, SceneFaces]) -> None:
    """Another seed has other objects, other textures, other flights and other telemetry errors."""
    options, other = tiny(name), tiny(name, seed=12)
    scene = build_scene(other.scene)
    mine = {tuple(face.origin.tolist()) for face in scenes[name].faces}
    assert len(mine & {tuple(face.origin.tolist()) for face in scene.faces}) < 0.7 * len(mine)
    texture = GROUND[name]
    small = [replace(s.canvases[texture][1], texels_per_m=4.0) for s in (scenes[name], scene)]
    painter = scene.canvases[texture][0]
    images = [
        paint(replace(scene, canvases={texture: (painter, canvas)}), texture) for canvas in small
    ]
    assert np.abs(images[0].astype(int) - images[1]).mean() > 2.0
    for flight, path in simulate_paths(options).items():
        changed = simulate_paths(other)[flight]
        assert np.abs(path.poses.centers[0] - changed.poses.centers[0]).max() > 1e-3
        errors = [
            simulate_telemetry(p, o).errors_m[0] for p, o in ((path, options), (changed, other))
        ]
        assert np.abs(errors[0] - errors[1]).max() > 1e-3


@pytest.mark.parametrize(
    ("name", "seed"), [("modern", 1), ("modern", 2), ("street", 1), ("street", 2), ("village", 1)]
)
def test_flights_stay_clear_of_what_stands_there(name: str, seed: int) -> None:
    """No camera is within 0.5 m of an obstacle."""
    options = replace(preset(name, seed=seed), fps=4.0)
    boxes = build_scene(options.scene).obstacles
    for path in simulate_paths(options).values():
        centers = path.poses.centers
        gaps = np.maximum(boxes[:, None, :3] - centers, centers - boxes[:, None, 3:])
        distances = np.linalg.norm(np.maximum(gaps, 0.0), axis=2)
        assert distances.min() > 0.5, path.name


def test_look_alike_has_the_same_walls_and_windows_but_other_textures() -> None:
    """Walls and flights are those of `standard` of the same seed; stains and posters are not."""
    options, other = tiny("standard"), tiny("look-alike")
    scene, alike = build_scene(options.scene), build_scene(other.scene)
    for name in ("facade-north", "facade-west"):
        one, two = (next(f for f in s.faces if f.texture == name) for s in (scene, alike))
        np.testing.assert_array_equal(one.origin, two.origin)
        images = [paint(s, name) for s in (scene, alike)]
        panes = [image[:, :, 3] == images[0][:, :, 3].max() for image in images]
        assert (panes[0] == panes[1]).mean() > 0.98
        assert np.abs(images[0][:, :, :3].astype(int) - images[1][:, :, :3]).mean() > 10
    for flight, path in simulate_paths(options).items():
        np.testing.assert_array_equal(
            path.poses.centers, simulate_paths(other)[flight].poses.centers
        )


@pytest.mark.parametrize("name", ["modern", "street", "village"])
def test_people_cars_and_leaves_move_and_nothing_else_does(
    name: str, scenes: dict[str, SceneFaces]
) -> None:
    """People and cars travel at their speed, crowns sway by centimetres, and all other faces stay."""
    scene = scenes[name]
    kinds = {type(face.body) for face in scene.faces}
    assert kinds == {type(None), Ride, Sway}
    for face in scene.faces:
        if isinstance(face.body, Ride):
            one, two = (face.body.at(t).shift[:2] for t in (3.0, 3.01))
            moved = np.linalg.norm(two - one)
            # At the end of a line it turns or starts again.
            assert moved <= 0.0101 * face.body.speed_m_s or moved > 1.0
            assert face.texture.startswith(("car", "cloth", "planks"))
        elif isinstance(face.body, Sway):
            assert 1e-4 < np.abs(face.body.at(3.0).shift - face.body.at(3.7).shift).max() < 0.6
            assert face.texture == "leaves"
    options = replace(tiny(name), width=320, height=180, length_factor=1.0, light=LightOptions())
    path = simulate_paths(options)["low" if name != "village" else "slant"]
    camera = SceneRenderer(
        scene.faces, flat(scene, car=(250, 0, 0), cloth=(250, 0, 0)), path.camera
    )
    images = []
    for clock_s in (0.0, 4.0):
        camera.set_time(clock_s)
        middle = len(path.time_s) // 2
        images.append(camera.render(path.poses.centers[middle], path.poses.rotations[middle]))
    changed = np.abs(images[0].astype(int) - images[1]).max(axis=2) > 60
    assert 5 < changed.sum() < 0.1 * changed.size


def test_a_post_casts_its_shadow_where_the_sun_says() -> None:
    """With the sun in the south at 45 degrees, a wall 3 m high darkens 3 m of the ground north of it."""
    ground = Face("g", np.array([-10, 10, 0.0]), np.array([20.0, 0, 0]), np.array([0, -20.0, 0]))
    wall = Face("w", np.array([-2, 0, 3.0]), np.array([4.0, 0, 0]), np.array([0, 0, -3.0]))
    toward_sun = np.array([0.0, -1.0, 1.0]) / np.sqrt(2)
    lit = cast_shadows([ground, wall], toward_sun)[0]
    scale = lit.shape[0] / 20.0
    for x, y, expected in ((0, 1.5, 0), (1.6, 2.6, 0), (0, 3.5, 1), (0, -0.5, 1), (2.5, 1.5, 1)):
        value = lit[int((10 - y) * scale), int((10 + x) * scale)]
        assert value == pytest.approx(expected, abs=0.05)


def test_sunlight_changes_during_a_flight_and_between_flights() -> None:
    """Clouds change the gain of a lit face, not of its own shadow by as much; flights have other suns."""
    paths = simulate_paths(replace(tiny("modern"), length_factor=1.0))
    suns = np.stack([path.sunlight.toward_sun for path in paths.values() if path.sunlight])
    assert len(suns) == len(paths)
    assert (suns @ suns.T - 2 * np.eye(len(suns))).max() < 0.9999
    light = Sunlight(np.array([0, 0, 1.0]), 0.0, LightOptions(sun=1.0))
    mask = np.array([[1.0, 0.0]], np.float32)
    gains = [light.gains({0: mask}, np.array([1.0, 0.0]), t) for t in np.arange(0, 45, 1.0)]
    lit, shade = np.array([images[0][0, :, 0] for _, images in gains]).T / GAIN_UNIT
    assert np.ptp(lit) > 0.4
    assert np.ptp(shade) < 0.25
    assert (lit >= shade - 0.01).all()
    assert all(path.sunlight is None for path in simulate_paths(tiny("standard")).values())


def test_lens_may_have_its_principal_point_off_the_centre() -> None:
    """The shift is in shares of the image, and rays and pixels agree to a thousandth of a pixel anywhere."""
    lens = LensOptions(fov_deg=90.0, distortion=(-0.24, 0.07, -0.0005, 0.0007), shift=(-0.01, 0.02))
    camera = lens.camera(1280, 720)
    np.testing.assert_allclose(camera.matrix[:2, 2], [640 - 12.8, 360 + 14.4])
    pixels = np.array([[0.5, 0.5], [1279.5, 0.5], [0.5, 719.5], [1279.5, 719.5], [640, 360]])
    rays = np.column_stack([camera.unproject(pixels), np.ones(5)])
    np.testing.assert_allclose(camera.project(rays), pixels, rtol=0, atol=1e-3)
    plain = Camera.from_horizontal_fov(1280, 720, 72.0, (-0.05, 0.015))
    np.testing.assert_array_equal(
        preset("standard").mapping_lens.camera(1280, 720).params, plain.params
    )


def test_lasting_gnss_error_is_that_of_all_flights() -> None:
    """The constant error is the same in each record of each flight of a seed, and another one by seed."""
    constants = []
    for seed in (1, 2):
        options = tiny("modern", seed)
        none = replace(options, gnss=replace(options.gnss, constant_sigma_m=(0.0, 0.0, 0.0)))
        shifts = [
            simulate_telemetry(path, options).errors_m - simulate_telemetry(path, none).errors_m
            for path in simulate_paths(options).values()
        ]
        both = np.concatenate(shifts)
        np.testing.assert_allclose(both, np.broadcast_to(both[0], both.shape), rtol=0, atol=1e-9)
        constants.append(both[0])
    assert np.abs(constants[0] - constants[1]).min() > 0.01


def test_courtyard_paths_are_refused_elsewhere() -> None:
    """A place with flights of its own refuses the courtyard's paths in one line."""
    with pytest.raises(
        InputError, match="paths nadir are flown in the courtyard only, not over street"
    ):
        replace(preset("street"), mapping_paths=MappingPaths.NADIR)
