"""Tests of models in VisualSFM's NVM format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.dataset.nvm import NvmModel, build_nvm_model, offsets_from_center, read_nvm, write_nvm
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats

TEXT = """NVM_V3

2
a/1.png 100 1 0 0 0 0 0 0 0 0
a/2.png 100 1 0 0 0 1 0 0 0 0

1
0.5 0 10 255 128 0 2 0 0 5 0 1 0 -5 0

0
"""


def model(seed: int = 0, images: int = 5, points: int = 40) -> NvmModel:
    """Return a random model whose points are measured without error."""
    random = np.random.default_rng(seed)
    poses = Poses(
        random.normal(0, 1, (images, 3)), canonical_quats(random.normal(0, 1, (images, 4)))
    )
    xyz = random.normal(0, 5, (points, 3))
    focal = random.uniform(500, 600, images)
    in_camera = np.einsum("nij,npj->npi", poses.rotations, xyz - poses.centers[:, None])
    image_idx, point_idx = np.nonzero(in_camera[..., 2] > 0.5)
    rays = in_camera[image_idx, point_idx]
    offsets = focal[image_idx, None] * rays[:, :2] / rays[:, 2:]
    colors = random.integers(0, 256, (points, 3)).astype(np.uint8)
    names = tuple(f"seq/{k:06d}.png" for k in range(images))
    return build_nvm_model(names, poses, focal, (xyz, colors), (point_idx, image_idx, offsets))


def test_a_model_is_read_back_bit_by_bit(tmp_path: Path) -> None:
    """A model is read back exactly, its quaternions to rounding."""
    written = model()
    write_nvm(tmp_path / "a.nvm", written)
    found = read_nvm(tmp_path / "a.nvm")
    assert found.names == written.names
    # Normalising the quaternions again may change the last bit.
    assert np.allclose(found.poses.quats_wxyz, written.poses.quats_wxyz, rtol=0, atol=1e-15)
    assert np.array_equal(found.poses.centers, written.poses.centers)
    for field in ("focal_px", "xyz", "colors", "point_idx", "image_idx", "offsets_px"):
        assert np.array_equal(getattr(found, field), getattr(written, field)), field
    assert not found.distortion.any()


def test_a_point_is_where_its_line_of_text_says(tmp_path: Path) -> None:
    """The measurements of a hand-written file equal the projections of its point."""
    (tmp_path / "a.nvm").write_text(TEXT)
    found = read_nvm(tmp_path / "a.nvm")
    assert found.offsets_px.tolist() == [[5, 0], [-5, 0]]
    for k in range(2):
        ray = found.poses.rotations[k] @ (found.xyz[0] - found.poses.centers[k])
        assert np.allclose(found.focal_px[k] * ray[:2] / ray[2], found.offsets_px[k])
    write_nvm(tmp_path / "b.nvm", found)
    assert (tmp_path / "b.nvm").read_text() == TEXT


def test_points_that_no_image_sees_are_left_out() -> None:
    """Points without measurements are dropped and the others renumbered."""
    made = build_nvm_model(
        ("a.png",),
        Poses(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])),
        np.array([100.0]),
        (np.arange(9.0).reshape(3, 3), np.zeros((3, 3), np.uint8)),
        (np.array([2, 1]), np.array([0, 0]), np.array([[1.0, 2], [3, 4]])),
    )
    assert made.xyz.tolist() == [[3, 4, 5], [6, 7, 8]]
    assert made.offsets_px.tolist() == [[3, 4], [1, 2]]
    assert made.feature_idx.tolist() == [0, 1]


def test_measurements_are_without_distortion_and_from_the_centre() -> None:
    """Offsets are f x/z and f y/z, without distortion or the principal point."""
    lens = Camera("OPENCV", 640, 480, np.array([500.0, 510, 330, 235, -0.1, 0.02, 1e-3, -2e-3]))
    points = np.array([[0.3, -0.2, 2.0], [0.0, 0.0, 1.0]])
    found = offsets_from_center(lens, lens.project(points), 700.0)
    assert np.allclose(found, [[105, -70], [0, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("NVM_V3", "NVM_V2", 1, "begins with 'NVM_V2', not NVM_V3"),
        ("\n2\n", "\n-2\n", 3, "is not a number from 0"),
        ("\n2\n", "\n99999999999999999999\n", 3, "is not a number from 0"),
        ("\n2\n", "\n3\n", 7, "expected 11"),
        ("a/2.png", "a/1.png", 5, "listed twice"),
        ("a/2.png", "a/2 x", 5, "expected 11"),
        ("0 0 0 0 0\n", "0 0 nan 0 0\n", 4, "not finite"),
        ("1 0 0 0 0 0 0 0 0", "x 0 0 0 0 0 0 0 0", 4, "could not convert"),
        (" 2 0 0 5", " 3 0 0 5", 8, "expected x y z r g b n"),
        (" 1 0 -5", " 2 0 -5", 8, "image 2 is out of range"),
        ("255", "256", 8, "from 0 to 255"),
        ("\n1\n0.5", "\n2\n0.5", 10, "1 fields, expected x y z"),
        (TEXT[20:], "", 1, "begins with"),
        ("\n1\n0.5 0 10 255 128 0 2 0 0 5 0 1 0 -5 0\n\n0\n", "", 5, "the file ends where"),
    ],
)
def test_a_broken_file_is_refused_with_its_line(
    old: str, new: str, line: int, words: str, tmp_path: Path
) -> None:
    """The error for a malformed file gives the line."""
    path = tmp_path / "a.nvm"
    assert old in TEXT
    text = TEXT.replace(old, new, 1) if old != TEXT[20:] else "garbage"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_nvm(path)
    assert caught.value.line == line


def test_an_absurd_count_takes_no_memory(tmp_path: Path) -> None:
    """A file that claims a hundred million points but has none is refused at its end."""
    path = tmp_path / "a.nvm"
    path.write_text("NVM_V3\n\n0\n\n100000000\n")
    with pytest.raises(InputError, match="the file ends where a point is expected"):
        read_nvm(path)
    path.write_bytes(b"\xff\xfe\n")
    with pytest.raises(InputError, match="not UTF-8"):
        read_nvm(path)
    with pytest.raises(InputError, match="can't be read"):
        read_nvm(tmp_path)


def test_what_can_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    """Names and values that cannot be read back are refused before writing."""
    whole = model()
    for names in (("a b.png", *whole.names[1:]), ("", *whole.names[1:])):
        broken = NvmModel(**{**vars(whole), "names": names})
        with pytest.raises(ValueError, match="is not a valid image name"):
            write_nvm(tmp_path / "a.nvm", broken)
    broken = NvmModel(**{**vars(whole), "focal_px": np.full(5, np.nan)})
    with pytest.raises(ValueError, match="not finite"):
        write_nvm(tmp_path / "a.nvm", broken)
    assert list(tmp_path.iterdir()) == []
