"""Tests of the scene-coordinate network: cell grid, mixture, loss, and training targets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from spn_data.dataset.hdf5_reader import FramePoints
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_model.examples.augment import WarpOptions, random_warp
from spn_model.examples.novel_views import NovelViewOptions, nearby_pose, warp_to_pose
from spn_model.examples.point_targets import (
    Surface,
    SurfaceOptions,
    cell_centers,
    cell_targets,
    surface,
)
from spn_model.networks.scene_coordinates import (
    FIRST_CELL_PX,
    PARTS,
    STRIDE_PX,
    SceneCoordinates,
    grid_size,
)
from spn_model.networks.scene_loss import mixture_loss

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = (480, 270)
LENS = Camera.from_horizontal_fov(*SIZE, 72.0)


@pytest.mark.parametrize("size", [(480, 270), (216, 121), (63, 64), (65, 97)])
def test_the_grid_is_that_of_the_network(size):
    """`grid_size` matches the network's output, which has three coordinates and a log scale per cell."""
    columns, rows = grid_size(*size)
    coordinates, log_scale = SceneCoordinates()(torch.zeros(2, 3, size[1], size[0]))
    assert coordinates.shape == (2, 3, rows, columns)
    assert log_scale.shape == (2, 1, rows, columns)


def test_a_small_image_is_refused():
    """Images below the smallest size, which have no cells at stride 16, are rejected."""
    with pytest.raises(ValueError, match="62 x 270 is smaller than 63"):
        grid_size(62, 270)


def test_it_is_small():
    """The whole state, buffers included, takes less than 5 MB in float32."""
    state = SceneCoordinates().state_dict()
    assert 4.3e6 < sum(4 * tensor.numel() for tensor in state.values()) < 5e6


def test_cells_lie_where_they_are_said_to():
    """The receptive field of a cell is centred on its stated pixel, along both paths, at even and odd cells.

    With average pooling in place of max pooling and equal positive weights, the network is linear and
    symmetric, so the centroid of its gradient is the cell's centre.
    """
    net = SceneCoordinates()
    for k in (2, 5, 8):
        net.features[k] = nn.AvgPool2d(3, stride=2, ceil_mode=True)
    for parameter in net.parameters():
        nn.init.constant_(parameter, 0.01 if parameter.dim() > 1 else 0.0)
    for cell in ((54, 55), (55, 54)):
        image = torch.ones(1, 3, 881, 881, requires_grad=True)
        net(image)[0][0, 0, cell[1], cell[0]].backward()
        seen = image.grad[0, 0].double()
        pixel = torch.arange(881) + 0.5
        at = [(seen.sum(0) * pixel).sum() / seen.sum(), (seen.sum(1) * pixel).sum() / seen.sum()]
        expected = np.array(cell) * STRIDE_PX + FIRST_CELL_PX
        assert np.array([float(v) for v in at]) == pytest.approx(expected, abs=1e-3)


def test_names_of_the_features_are_the_published_ones():
    """SqueezeNet 1.1 parameters use torchvision's names; all other parameters are listed as added."""
    net = SceneCoordinates()
    published = {name for name in net.state_dict() if name.startswith("features.")}
    assert {"features.0.weight", "features.12.expand3x3.bias"} <= published
    assert len(published) == 50
    assert {n.partition(".")[0] for n in set(net.state_dict()) - published} == set(net.added)
    groups = net.parameter_groups()
    assert sum(p.numel() for p in groups["pretrained"]) == 722_496


def test_frozen_features_take_no_gradient():
    """Frozen early layers get no gradient, while later layers and the head do."""
    net = SceneCoordinates()
    net.freeze_features(5)
    coordinates, log_scale = net(torch.rand(1, 3, 64, 64))
    (coordinates.sum() + log_scale.sum()).backward()
    assert net.features[4].squeeze.weight.grad is None
    assert net.features[6].squeeze.weight.grad is not None
    assert net.fine.weight.grad is not None


def test_the_head_starts_from_features_of_size_one():
    """After `measure_features`, the head's input has zero mean and unit variance on the same images."""
    net = SceneCoordinates()
    images = torch.rand(3, 3, 96, 96)
    net.measure_features(images)
    received = net._normalised("fine", net.features[:8](images)).detach()
    assert float(received.mean()) == pytest.approx(0, abs=1e-4)
    assert float(received.square().mean()) == pytest.approx(1, abs=1e-3)
    before = net(images)[0]
    net.fine_std.mul_(2)
    assert not torch.equal(net(images)[0], before)


def test_coordinates_are_not_rounded_in_bfloat16():
    """Under autocast, coordinates keep more digits than bfloat16 can represent."""
    net = SceneCoordinates()
    nn.init.normal_(net.out.weight, std=0.1)
    with torch.autocast("cpu", torch.bfloat16):
        coordinates, _ = net(torch.rand(1, 3, 96, 96))
    assert coordinates.dtype == torch.float32
    lost = coordinates - coordinates.bfloat16().float()
    assert float((lost / coordinates).abs().median().detach()) > 1e-4


def test_the_scene_is_measured_by_medians():
    """One extreme outlier point hardly changes the scene's centre and spread."""
    net = SceneCoordinates()
    xyz = torch.randn(999, 3) + torch.tensor([5.0, 6.0, 7.0])
    net.set_scene(torch.cat([xyz, torch.full((1, 3), 1e6)]))
    assert net.center.tolist() == pytest.approx([5, 6, 7], abs=0.15)
    assert 1 < float(net.spread) < 2


def test_the_loss_is_least_at_the_true_scale_and_weights():
    """For errors drawn from a mixture of two places, the loss is lowest at its true scale and weights."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    places = torch.tensor([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]], dtype=torch.float64)
    targets = places[torch.from_numpy((rng.random(4000) < 0.25).astype(int))]
    targets = targets + torch.from_numpy(direction * rng.gamma(3.0, 0.7, (4000, 1)))

    def loss(scale: float, second: float) -> float:
        logits = torch.tensor([1 - second, second], dtype=torch.float64).log().expand(4000, 2)
        log_scale = torch.full((4000,), float(np.log(scale)), dtype=torch.float64)
        return float(mixture_loss(places.expand(4000, 2, 3), log_scale, logits, targets))

    assert loss(0.7, 0.25) < min(loss(0.63, 0.25), loss(0.77, 0.25))
    assert loss(0.7, 0.25) < min(loss(0.7, 0.15), loss(0.7, 0.35))


def test_only_the_place_that_explains_a_point_moves_toward_it():
    """The component near a point gets its gradient; one 20 scales away does not move to the middle."""
    candidates = torch.tensor([[[0.0, 0, 0], [20.0, 0, 0]]], requires_grad=True)
    mixture_loss(
        candidates, torch.zeros(1), torch.zeros(1, 2), torch.tensor([[1.0, 0.0, 0.0]])
    ).backward()
    assert candidates.grad[0, 0, 0] == pytest.approx(-1, abs=1e-3)
    assert float(candidates.grad[0, 1].abs().max()) < 1e-6


def test_coordinates_are_those_of_the_likeliest_part():
    """Of two parts with nearly equal weights, a cell is at the likelier one, not between the two."""
    net = SceneCoordinates()
    net.place.copy_(torch.arange(3.0 * PARTS).reshape(3, PARTS))
    for layer in (net.out, net.pick):
        nn.init.zeros_(layer.weight)
    with torch.no_grad():
        net.pick.bias[[5, 40]] = torch.tensor([1.0, 1.01])
        net.offset.bias[3 * 40 : 3 * 41] = torch.tensor([1.0, 2.0, 3.0])
    coordinates, _ = net(torch.rand(1, 3, 64, 64))
    expected = net.place[:, 40] + 0.3 * torch.tensor([1.0, 2.0, 3.0])
    assert (coordinates - expected[:, None, None]).abs().max() < 1e-4


def test_it_learns_one_image():
    """Thirty steps on one small image halve the distance to its targets and reduce the predicted scale."""
    net = SceneCoordinates()
    image = torch.rand(1, 3, 96, 96)
    columns, rows = grid_size(96, 96)
    targets = torch.from_numpy(cell_centers(columns, rows, 0.0, 1.0)).float().T
    targets = torch.cat([targets, targets[:1] * 0.5]).reshape(1, 3, rows, columns) + 20
    net.set_scene(targets[0].reshape(3, -1).T)
    net.measure_features(image)
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3)
    true = targets.permute(0, 2, 3, 1).reshape(-1, 3)
    distances, scales = [], []
    for _ in range(30):
        candidates, log_scale, logits = net.cells(image)
        candidates = candidates.permute(0, 3, 4, 1, 2).reshape(-1, PARTS, 3)
        logits = logits.permute(0, 2, 3, 1).reshape(-1, PARTS)
        choice = functional.cross_entropy(logits, net.part_of(true))
        loss = mixture_loss(candidates, log_scale.flatten(), logits, true) + choice
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        distances.append(float((net(image)[0] - targets).norm(dim=1).mean().detach()))
        scales.append(float(log_scale.mean().detach()))
    assert distances[-1] < 0.5 * distances[0]
    assert scales[-1] < scales[0] - 0.3


def test_parts_of_the_scene_are_where_points_are():
    """Four point clusters share 48 part centres, each within a cluster; outliers belong to no part."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.tensor([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [30, 30, 0]])
    points = corners.repeat(500, 1) + torch.rand(2000, 3, generator=generator)
    net = SceneCoordinates()
    net.set_scene(torch.cat([points, torch.full((3, 3), 1e5)]))
    middles = net.place.T * net.spread + net.center
    off = (middles[:, None] - corners - 0.5).abs().amax(dim=2).min(dim=1).values
    assert float(off.max()) < 0.6
    assert len(net.part_of(points).unique()) == 48
    other = SceneCoordinates()
    other.set_scene(torch.cat([points, torch.full((3, 3), 1e5)]))
    assert torch.equal(other.place, net.place)


def test_few_points_make_a_scene_too():
    """With fewer points than parts, part centres are still finite."""
    net = SceneCoordinates()
    net.set_scene(torch.rand(5, 3))
    assert torch.isfinite(net.place).all()


def test_a_cell_takes_the_point_nearest_to_its_middle():
    """Of two points in a cell the one nearer to its centre is used; points outside all cells are ignored."""
    pixels = np.array(
        [[10.9, 7.0], [7.6, 7.6], [-3.0, 5.0], [np.nan, np.nan], [15.5, 23.4], [900, 9]]
    )
    xyz = np.arange(18.0).reshape(6, 3)
    targets, known = cell_targets(pixels, xyz, (3, 4), first_px=7.5, stride_px=8)
    assert np.argwhere(known).tolist() == [[0, 0], [2, 1]]
    assert targets[:, 0, 0].tolist() == [3, 4, 5]
    assert targets[:, 2, 1].tolist() == [12, 13, 14]
    assert targets.dtype == np.float32
    assert np.count_nonzero(targets[:, ~known]) == 0


def look_at_the_ground(pitch_deg: float) -> Poses:
    return Poses.from_rotations(
        [[5.0, -3.0, 8.0]], rotations_from_angles(np.array([[30.0, pitch_deg, 4.0]]))
    )


def ground_points(pose: Poses, count: int, seed: int = 0) -> FramePoints:
    """Return points of level ground at height 1 m seen by a camera at random pixels."""
    pixels = np.random.default_rng(seed).uniform([0, 0], SIZE, (count, 2))
    rays = np.column_stack([LENS.unproject(pixels), np.ones(count)]) @ pose.rotations[0]
    xyz = pose.centers[0] + rays * ((1.0 - pose.centers[0, 2]) / rays[:, 2])[:, None]
    return FramePoints(np.arange(count), pixels, xyz)


def test_flat_ground_between_points_is_exact():
    """The surface of a plane seen at an angle is exact to 1e-4 m along any pixel's own ray."""
    pose = look_at_the_ground(-50.0)
    seen = surface(ground_points(pose, 600), pose, LENS.matrix, SIZE, SurfaceOptions())
    rng = np.random.default_rng(1)
    # Depth is constant within a cell of the stored grid, so use pixels at cell centres.
    pixels = np.floor(rng.uniform([40, 40], [440, 230], (300, 2)) / 2) * 2 + 1
    xyz = seen.xyz(pixels)
    assert np.isfinite(xyz).all()
    assert xyz[:, 2] == pytest.approx(1.0, abs=1e-4)
    back = LENS.project((xyz - pose.centers[0]) @ pose.rotations[0].T)
    assert back == pytest.approx(pixels, abs=1e-6)


def test_a_jump_in_depth_is_no_surface():
    """No surface spans the gap between a near and a far wall, while nearly all of each wall is covered."""
    pose = Poses.from_rotations([[0.0, 0, 0]], np.eye(3)[None])
    pixels = np.random.default_rng(0).uniform([0, 0], SIZE, (1500, 2))
    pixels = pixels[np.abs(pixels[:, 0] - 240) > 8]
    depth = np.where(pixels[:, 0] < 240, 5.0, 12.0)
    xyz = np.column_stack([LENS.unproject(pixels), np.ones(len(pixels))]) * depth[:, None]
    seen = surface(
        FramePoints(np.arange(len(xyz)), pixels, xyz), pose, LENS.matrix, SIZE, SurfaceOptions()
    )
    at = cell_centers(120, 67, 2.0, 4.0)
    z = seen.xyz(at)[:, 2]
    assert np.isnan(z[np.abs(at[:, 0] - 240) < 6]).all()
    inner = (np.abs(at[:, 0] - 240) > 20) & (np.abs(at - [240, 135]) < [215, 110]).all(axis=1)
    assert np.isfinite(z[inner]).mean() > 0.98
    assert set(np.round(z[inner & np.isfinite(z)], 3)) == {5.0, 12.0}


@pytest.mark.parametrize("count", [0, 2])
def test_without_points_nothing_is_known(count):
    """An image with fewer than three points has no surface and raises no error."""
    pose = look_at_the_ground(-50.0)
    some = ground_points(pose, 3)
    few = FramePoints(some.ids[:count], some.pixels[:count], some.xyz[:count])
    seen = surface(few, pose, LENS.matrix, SIZE, SurfaceOptions())
    assert np.isnan(seen.xyz(np.array([[100.0, 100.0]]))).all()
    with pytest.raises(ValueError, match="surface that the image shows is unknown"):
        nearby_pose(np.random.default_rng(0), seen, NovelViewOptions())


def test_targets_of_a_virtual_camera_are_what_its_pixels_show():
    """Targets of a rotated and zoomed image project exactly onto its cell centres."""
    pose = look_at_the_ground(-45.0)
    seen = surface(ground_points(pose, 800), pose, LENS.matrix, SIZE, SurfaceOptions())
    virtual = random_warp(np.random.default_rng(2), LENS.matrix, SIZE, WarpOptions(), zoom=0.8)
    at = cell_centers(*grid_size(*SIZE), FIRST_CELL_PX, STRIDE_PX)
    xyz = seen.xyz(virtual.source_pixels(at))
    known = np.isfinite(xyz).all(axis=1)
    assert known.mean() > 0.4
    turned = virtual.pose(pose)
    lens = Camera("PINHOLE", *SIZE, virtual.matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    pixels = lens.project((xyz[known] - turned.centers[0]) @ turned.rotations[0].T)
    assert pixels == pytest.approx(at[known], abs=1e-6)
    assert xyz[known][:, 2] == pytest.approx(1.0, abs=0.08)


def checkered(pose: Poses) -> np.ndarray:
    """Render smoothly chequered ground at height 1 m, with one value per ground position."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    rays = np.column_stack([LENS.unproject(pixels), np.ones(len(pixels))]) @ pose.rotations[0]
    place = pose.centers[0] + rays * ((1.0 - pose.centers[0, 2]) / rays[:, 2])[:, None]
    value = 128 + 60 * np.sin(2 * place[:, 0]) + 60 * np.cos(2 * place[:, 1])
    return np.repeat(np.rint(value).astype(np.uint8).reshape(270, 480, 1), 3, axis=2)


def test_a_virtual_view_is_what_a_camera_there_would_see():
    """A view warped 4 m up and 2 m aside is within 3 of 255 grey levels, its surface on the ground."""
    pose = look_at_the_ground(-50.0)
    seen = surface(ground_points(pose, 900), pose, LENS.matrix, SIZE, SurfaceOptions())
    there = Poses.from_rotations(
        [[6.0, -4.5, 12.0]], rotations_from_angles(np.array([[26.0, -58.0, 2.0]]))
    )
    image, moved = warp_to_pose(checkered(pose), seen, there, (255, 0, 255))
    drawn = ~(image == [255, 0, 255]).all(axis=2)
    assert drawn.mean() > 0.2
    error = np.abs(image[..., 0].astype(float) - checkered(there)[..., 0])[drawn]
    assert np.median(error) < 3
    assert np.percentile(error, 95) < 12
    z = moved.xyz(cell_centers(240, 135, 1.0, 2.0))[:, 2]
    assert np.nanmax(np.abs(z - 1.0)) < 0.1
    assert moved.pose is there


def test_a_near_wall_hides_what_is_behind():
    """If two surfaces project to the same pixels, the nearer one is visible."""
    depth = np.full((135, 240), 10.0, np.float32)
    depth[:, :120] = 4.0
    here = Poses.from_rotations([[0.0, 0, 0]], np.eye(3)[None])
    seen = Surface(1 / depth, 2, here, LENS.matrix)
    image = np.where(np.arange(480)[None, :, None] < 240, [[[200, 0, 0]]], [[[0, 0, 200]]])
    image = np.broadcast_to(image, (270, 480, 3)).astype(np.uint8)
    left = Poses.from_rotations([[-1.0, 0, 0]], np.eye(3)[None])
    drawn, moved = warp_to_pose(image, seen, left, (0, 0, 0))
    edge = int(240 + LENS.focal_px[0] * 1.0 / 4.0)
    assert drawn[135, edge - 12].tolist() == [200, 0, 0]
    assert drawn[135, edge + 12].tolist() == [0, 0, 200]
    assert 1 / moved.inverse_depth[67, (edge - 12) // 2] == pytest.approx(4.0, rel=0.01)


def test_virtual_cameras_rise_and_keep_their_view():
    """Sampled positions respect the options, are not below the real camera, and keep its target in view."""
    pose = look_at_the_ground(-40.0)
    seen = surface(ground_points(pose, 600), pose, LENS.matrix, SIZE, SurfaceOptions())
    rng = np.random.default_rng(0)
    aim = np.array([[240.0, 135.0]])
    for _ in range(20):
        place = nearby_pose(rng, seen, NovelViewOptions(rise_m=6.0, side_m=2.0))
        move = (place.centers - pose.centers)[0]
        assert 0 <= move[2] <= 6
        assert np.abs(move[:2]).max() <= 2
        pixel = LENS.project((seen.xyz(aim) - place.centers) @ place.rotations[0].T)[0]
        assert 0 < pixel[0] < 480
        assert 0 < pixel[1] < 270
