"""Tests of baselines, on poses and images with known answers."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from spn_data.dataset.cambridge import read_cambridge
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import quats_from_rotations, rotations_from_vectors
from spn_model.evaluation.baselines import (
    PAPER_TABLE_1,
    GemOptions,
    VladOptions,
    baselines,
    better_retrieval,
    gem,
    gem_pool,
    mean_pose,
    mean_pose_estimates,
    nearest_pose_estimates,
    retrieve,
    vlad,
)
from spn_model.evaluation.metrics import Estimates, evaluate, evaluation_frames


@dataclass
class Pictures:
    """Images in memory."""

    pixels: np.ndarray
    masks: list[np.ndarray | None] = field(default_factory=list)
    poses: Poses | None = None

    def __len__(self):
        return len(self.pixels)

    def image(self, row):
        return self.pixels[row]

    def valid(self, row):
        return self.masks[row] if self.masks else None


def textures(n, seed=0, size=(90, 160)):
    """Return different textures with corners and blobs, shape (n, H, W, 3), uint8."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (n, size[0] // 6, size[1] // 6, 3), dtype=np.uint8)
    return np.stack([cv2.resize(s, size[::-1], interpolation=cv2.INTER_CUBIC) for s in small])


def seen_again(images, shift=5, seed=1):
    """Return the same textures, shifted, darkened and with noise."""
    rng = np.random.default_rng(seed)
    moved = np.roll(images, shift, axis=2).astype(float)
    return np.clip(0.8 * moved + rng.normal(scale=4, size=images.shape), 0, 255).astype(np.uint8)


def some_poses(n, seed=0):
    rng = np.random.default_rng(seed)
    return Poses.from_rotations(
        rng.normal(size=(n, 3)), rotations_from_vectors(rng.normal(size=(n, 3)))
    )


def test_mean_of_turns_about_one_axis_is_the_middle_turn():
    """The mean of rotations by 10, 20 and 30 deg about up is 20 deg, whatever the quaternions' signs."""
    vectors = np.zeros((3, 3))
    vectors[:, 2] = np.deg2rad([10, 20, 30])
    quats = quats_from_rotations(rotations_from_vectors(vectors))
    for signs in ([1, 1, 1], [1, -1, 1]):
        center, quat = mean_pose(
            Poses(np.array([[0.0, 0, 0], [3, 0, 0], [0, 6, 3]]), quats * np.array(signs)[:, None])
        )
        np.testing.assert_allclose(center, [1, 2, 1])
        np.testing.assert_allclose(quat, quats[1], atol=1e-12)


def test_mean_minimises_squared_chords():
    """No small rotation of the mean reduces the sum of squared chordal distances (Markley)."""
    poses = some_poses(30, seed=4)
    _, quat = mean_pose(poses)

    def cost(rotation):
        return ((poses.rotations - rotation) ** 2).sum()

    mean = Poses(np.zeros((1, 3)), quat[None]).rotations[0]
    for turn in np.concatenate([np.eye(3), -np.eye(3)]) * 0.01:
        assert cost(rotations_from_vectors(turn[None])[0] @ mean) > cost(mean)


def test_figures_of_shop_facade(shared_data):
    """The public pose lists give medians of 8.60 m, 33.75 deg (mean pose) and 0.75 m, 8.5 deg (oracle).

    The mean of quaternions aligned in sign to the first, which depends on the order, gives 34.0 deg. PoseNet
    in the literature has 1.46 m, 8.08 deg there: no better in position than the oracle.
    """
    folder = shared_data / "cambridge" / "ShopFacade"
    training = read_cambridge(folder / "dataset_train.txt").poses
    test = read_cambridge(folder / "dataset_test.txt")
    assert (len(training), len(test)) == (231, 103)
    frames = evaluation_frames(
        "test", np.array(test.names), np.full(len(test), ""), test.poses, training
    )
    mean = evaluate(mean_pose_estimates(training, len(test)), frames).summary
    best = evaluate(nearest_pose_estimates(training, test.poses), frames).summary
    assert mean.position.median == pytest.approx(8.60, abs=0.005)
    assert mean.rotation_deg.median == pytest.approx(33.75, abs=0.005)
    assert best.position.median == pytest.approx(0.75, abs=0.005)
    assert best.rotation_deg.median == pytest.approx(8.5, abs=0.05)
    assert best.position.p95 == pytest.approx(2.15, abs=0.005)


def test_oracle_is_the_best_of_all_training_poses():
    """By brute force, no training pose has a smaller sum of distance and angle / 10."""
    training, true = some_poses(40, seed=1), some_poses(15, seed=2)
    found = nearest_pose_estimates(training, true).poses
    error_m, error_deg = pose_errors(found, true)
    for k in range(len(true)):
        pairs = pose_errors(training, true[np.full(len(training), k)])
        assert error_m[k] + error_deg[k] / 10 == pytest.approx((pairs[0] + pairs[1] / 10).min())


def test_nothing_to_learn_from_is_an_error():
    """Mean pose and oracle raise an error if there are no training poses."""
    none, true = some_poses(0), some_poses(3)
    with pytest.raises(ValueError, match="cannot average zero poses"):
        mean_pose_estimates(none, 3)
    with pytest.raises(GeometryError):
        nearest_pose_estimates(none, true)


def test_vlad_finds_the_same_place():
    """VLAD retrieves the pose of the matching training image for each modified texture."""
    images = textures(12)
    training = some_poses(12)
    order = np.random.default_rng(3).permutation(12)
    describe = vlad(Pictures(images), VladOptions(words=16))
    found = retrieve(
        "vlad", training, describe(Pictures(images)), describe(Pictures(seen_again(images[order])))
    )
    np.testing.assert_array_equal(found.poses.centers, training.centers[order])
    np.testing.assert_array_equal(found.poses.quats_wxyz, training.quats_wxyz[order])


def test_vocabulary_is_of_the_training_images_alone():
    """Descriptors do not depend on images described before, and are the same in a second run."""
    images = textures(6)
    describe = vlad(Pictures(images), VladOptions(words=8))
    before = describe(Pictures(images))
    describe(Pictures(textures(4, seed=9)))
    np.testing.assert_array_equal(describe(Pictures(images)), before)
    np.testing.assert_array_equal(
        vlad(Pictures(images), VladOptions(words=8))(Pictures(images)), before
    )


def test_masked_pixels_do_not_describe():
    """Images that differ only in masked pixels have the same descriptor."""
    images = textures(2, size=(90, 360))
    other = images.copy()
    other[:, :, 240:] = textures(2, seed=5, size=(90, 120))
    mask = np.zeros(images.shape[1:3], bool)
    mask[:, :60] = True  # far from what differs: SIFT looks beyond its keypoint
    describe = vlad(Pictures(images), VladOptions(words=8))
    masked = [describe(Pictures(pixels, [mask, mask])) for pixels in (images, other)]
    assert np.all(np.linalg.norm(masked[0], axis=1) > 0.99)
    np.testing.assert_allclose(masked[0], masked[1], atol=1e-6)
    assert np.abs(describe(Pictures(other)) - describe(Pictures(images))).max() > 0.1


def test_an_image_that_shows_nothing_gets_no_pose():
    """A black image, which has no features, gets NaN instead of the first training pose."""
    images = textures(5)
    describe = vlad(Pictures(images), VladOptions(words=8))
    black = np.zeros_like(images[:1])
    found = retrieve("vlad", some_poses(5), describe(Pictures(images)), describe(Pictures(black)))
    assert np.isnan(found.poses.centers).all()
    assert np.isnan(found.poses.quats_wxyz).all()


def test_pool_is_the_power_mean():
    """Power 1 gives the mean, a high power nearly the maximum, and 3 the cube root of the mean cube."""
    maps = np.array([[[[1.0, 2], [3, 2]], [[0, 0], [0, 4]]]])
    for power, wanted in (
        (1.0, [2, 1]),
        (3.0, [11 ** (1 / 3), 4 * 0.25 ** (1 / 3)]),
        (500.0, [3, 4]),
    ):
        found = gem_pool(maps, GemOptions(power=power))
        np.testing.assert_allclose(found[0], wanted / np.linalg.norm(wanted), rtol=3e-3)
    assert np.array_equal(gem_pool(np.zeros((1, 3, 2, 2)), GemOptions()), np.zeros((1, 3)))


def test_gem_does_not_depend_on_batches():
    """Descriptors are the same in batches of 2 and of 8, in the order of the images."""
    images = Pictures(textures(5))

    def maps(batch):
        assert batch.dtype == np.uint8
        return np.transpose(batch[:, ::9, ::9].astype(np.float32), (0, 3, 1, 2))

    small, large = (gem(maps, GemOptions(batch=n))(images) for n in (2, 8))
    assert small.shape == (5, 3)
    np.testing.assert_allclose(small, large)
    np.testing.assert_allclose(np.linalg.norm(small, axis=1), 1, rtol=1e-6)


def test_all_baselines_of_several_groups():
    """Each group gets mean pose, oracle and each retrieval method; training frames are rejected."""
    images, poses = textures(6), some_poses(6)
    training = Pictures(images, poses=poses)
    groups = [Pictures(seen_again(images[rows]), poses=poses[rows]) for rows in ([4, 1], [2])]
    describe = {"a": vlad(training, VladOptions(words=8)), "b": lambda i: np.ones((len(i), 1))}
    first, second = baselines(training, groups, describe)
    names = ["mean training pose", "nearest training pose (oracle)", "a", "b"]
    assert [one.method for one in first] == [one.method for one in second] == names
    for one in first[1:3]:
        np.testing.assert_array_equal(one.poses.centers, poses.centers[[4, 1]])
    np.testing.assert_array_equal(second[2].poses.centers, poses.centers[[2]])
    np.testing.assert_array_equal(second[3].poses.centers, poses.centers[[0]])
    with pytest.raises(ValueError, match="retrieve itself"):
        baselines(training, [training], {})


def test_feature_maps_are_those_of_squeezenet():
    """Feature maps equal fire9 of the shipped weights, computed with plain convolutions and ReLUs."""
    torch = pytest.importorskip("torch")
    from spn_model.evaluation.feature_maps import squeezenet_maps
    from spn_model.pretrained.tensors import read_tensors
    from spn_model.pretrained.weights import find

    weights = {k: v.float() for k, v in read_tensors(find("squeezenet1_1-features")).items()}

    def conv(x, name, **how):
        return torch.relu(
            torch.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], **how)
        )

    def fire(x, name):
        x = conv(x, f"{name}.squeeze")
        wide = conv(x, f"{name}.expand3x3", padding=1)
        return torch.cat([conv(x, f"{name}.expand1x1"), wide], 1)

    images = textures(2)
    x = torch.from_numpy(images).permute(0, 3, 1, 2) / 255
    x = (x - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / torch.tensor(
        [0.229, 0.224, 0.225]
    ).view(3, 1, 1)
    x = conv(x, "features.0", stride=2)
    for layer in range(2, 13):
        pools = layer in (2, 5, 8)
        x = torch.max_pool2d(x, 3, 2, ceil_mode=True) if pools else fire(x, f"features.{layer}")
    found = squeezenet_maps()(images)
    assert found.shape == (2, 512, 5, 9)
    assert found.min() == 0
    np.testing.assert_allclose(found, x.numpy(), atol=2e-3 * float(x.max()))


def test_the_better_retrieval_has_the_smaller_error():
    """Retrieval is ranked by the median of metres plus degrees / 10; missing poses make it worse."""
    true = some_poses(3)
    frames = evaluation_frames("a", np.array(["0", "1", "2"]), np.full(3, ""), true, true)
    near = Estimates("near", Poses(true.centers + np.array([0.1, 0, 0]), true.quats_wxyz))
    far = Estimates("far", Poses(true.centers + np.array([0.2, 0, 0]), true.quats_wxyz))
    centers = true.centers.copy()
    centers[:2] = np.nan
    lost = Estimates("lost", Poses(centers, true.quats_wxyz))
    found = [evaluate(e, frames) for e in (far, lost, near)]
    assert better_retrieval(found).method == "near"
    assert better_retrieval(found[1::-1]).method == "far"


def test_the_papers_table_is_the_papers():
    """The table has three networks on both sequences, with SqueezePoseNet as in the abstract."""
    table = {(p.network, p.sequence): (p.position_m, p.rotation_deg) for p in PAPER_TABLE_1}
    assert len(table) == len(PAPER_TABLE_1) == 6
    assert table["SqueezePoseNet", "medium"] == (5.19, 29.28)
    assert table["SqueezePoseNet", "low"] == (15.18, 65.02)
