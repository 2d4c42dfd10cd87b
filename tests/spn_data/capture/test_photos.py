"""Tests of photos: upright decoding to 8 bits, unreadable files among good ones, and masks."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from spn_data.capture.photos import decode_photo, decode_photo_gray, load_mask, read_headers
from spn_data.errors import InputError


def marked_photo(width: int = 64, height: int = 48) -> np.ndarray:
    """Create a dark RGB image with a green upper-left quarter."""
    image = np.full((height, width, 3), (120, 30, 30), np.uint8)
    image[: height // 2, : width // 2] = (0, 255, 0)
    return image


def save(path: Path, array: np.ndarray, orientation: int = 1) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(array).save(path, exif=exif)
    return path


# EXIF orientation -> upright size, and the corner where the stored upper-left one ends up (right, lower).
UPRIGHT = {
    1: ((64, 48), (0, 0)),
    2: ((64, 48), (1, 0)),
    3: ((64, 48), (1, 1)),
    4: ((64, 48), (0, 1)),
    5: ((48, 64), (0, 0)),
    6: ((48, 64), (1, 0)),
    7: ((48, 64), (1, 1)),
    8: ((48, 64), (0, 1)),
}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("orientation", sorted(UPRIGHT))
def test_photos_stand_upright(tmp_path: Path, orientation: int, suffix: str) -> None:
    """All eight EXIF orientations are applied in three formats: in colour, in grey and in the header."""
    path = save(tmp_path / f"a{suffix}", marked_photo(), orientation)
    (width, height), (right, lower) = UPRIGHT[orientation]
    image = decode_photo(path)
    gray = decode_photo_gray(path, max_width=640)
    assert image.shape == (height, width, 3)
    assert gray.shape == (height, width)
    np.testing.assert_array_equal(read_headers([path]).sizes, [[width, height]])
    y, x = (5 + lower * (height - 11), 5 + right * (width - 11))
    np.testing.assert_allclose(image[y, x], (0, 255, 0), atol=8)  # BGR
    assert gray[y, x] > 140 > gray[height - 1 - y, width - 1 - x]


def test_one_unreadable_photo_does_not_stop_the_others(tmp_path: Path) -> None:
    """Non-photos and empty files are reported when reading headers; truncated photos, when decoding."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (200, 300, 3), dtype=np.uint8)
    good = [save(tmp_path / f"{name}.jpg", noise) for name in "abc"]
    text = tmp_path / "text.jpg"
    text.write_text("no photo")
    empty = tmp_path / "empty.jpg"
    empty.touch()
    good[1].write_bytes(good[1].read_bytes()[:9000])
    headers = read_headers([good[0], text, empty, good[1], good[2]])
    assert [m is not None for m in headers.metadata] == [True, False, False, True, True]
    assert [bool(p) for p in headers.problem] == [False, True, True, False, False]
    assert headers.problem[1].startswith("cannot be read as a photo")
    assert headers.sizes.tolist() == [[300, 200], [0, 0], [0, 0], [300, 200], [300, 200]]
    for decoder in (decode_photo, lambda p: decode_photo_gray(p, max_width=100)):
        with pytest.raises(InputError, match="cannot be read as an image: it is truncated"):
            decoder(good[1])
        decoder(good[2])


def test_deep_photos_are_scaled_to_8_bits(tmp_path: Path) -> None:
    """16-bit values keep their upper byte; floating-point images have no known range and are refused."""
    deep = np.full((10, 20), 0x8F12, np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    assert decode_photo(tmp_path / "deep.png")[0, 0].tolist() == [0x8F] * 3
    Image.fromarray(np.full((10, 20), 21.5, np.float32)).save(tmp_path / "thermal.tif")
    with pytest.raises(InputError, match=r"thermal\.tif: pixel format 'F'"):
        decode_photo(tmp_path / "thermal.tif")


def few_values(path: Path, *, channels: int = 1, high: int = 4095) -> Path:
    """Write a 16-bit image whose values range from 0 to `high`."""
    values = np.linspace(0, high, 64 * 48 * channels).astype(np.uint16)
    shape = (48, 64, channels) if channels > 1 else (48, 64)
    assert cv2.imwrite(str(path), values.reshape(shape))
    return path


@pytest.mark.parametrize("name", ["band.png", "band.tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_few_of_16_bits_are_refused(tmp_path: Path, name: str, channels: int) -> None:
    """12-bit data in 16-bit files is refused with its range, for full decoding and previews."""
    path = few_values(tmp_path / name, channels=channels)
    for decoder in (decode_photo, lambda p: decode_photo_gray(p, max_width=100)):
        with pytest.raises(
            InputError, match=r"uses only values \d+ to 3\d\d\d of 16 bits, of which 15"
        ):
            decoder(path)
    whole = few_values(tmp_path / f"whole-{name}", channels=channels, high=65535)
    assert decode_photo(whole).max() == 255


def test_a_decompression_bomb_is_refused_by_its_header(tmp_path: Path) -> None:
    """A PNG whose header claims 40,000 x 40,000 pixels is refused."""
    path = tmp_path / "bomb.png"
    header = b"IHDR" + struct.pack(">IIBBBBB", 40_000, 40_000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + b"\0\0\0\x10IDAT" + bytes(20))
    said = "its header claims more than 300 megapixels, the limit for a photo"
    assert read_headers([path]).problem == (said,)
    for decoder in (decode_photo, lambda p: decode_photo_gray(p, max_width=100)):
        with pytest.raises(InputError, match=said):
            decoder(path)


def test_lenses_are_told_apart(shared_data: Path) -> None:
    """Photos of one lens and size share a lens key, which differs from that of another set."""
    first = sorted((shared_data / "photos-two-passes").glob("*.JPG"))[:3]
    second = sorted((shared_data / "photos-dji-xmp").glob("*.[jJ]*"))[:2]
    lens = read_headers([*first, *second]).lens
    assert len(set(lens[:3])) == len(set(lens[3:])) == 1
    assert lens[0] != lens[3]


def test_grey_is_reduced_for_measuring(shared_data: Path) -> None:
    """Grey photos are reduced to the requested width and never enlarged."""
    path = min((shared_data / "photos-dji-xmp").glob("*.[jJ]*"))
    assert decode_photo_gray(path, max_width=640).shape == (360, 640)
    assert decode_photo_gray(path, max_width=9000).shape == (1125, 2000)


def test_a_mask_fits_by_shape(tmp_path: Path) -> None:
    """A mask of the same aspect ratio is resized without blending; any other is refused."""
    mask = np.zeros((90, 160), np.uint8)
    mask[:45] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    same = load_mask(tmp_path / "mask.png", 160, 90)
    assert (same.dtype, int(same.sum())) == (np.dtype(bool), 45 * 160)
    large = load_mask(tmp_path / "mask.png", 1280, 720)
    assert large[:360].all()
    assert not large[360:].any()
    with pytest.raises(
        InputError, match=r"mask\.png: the mask is 160x90 but the images are 640x480"
    ):
        load_mask(tmp_path / "mask.png", 640, 480)


def test_a_black_mask_is_refused(tmp_path: Path) -> None:
    """An entirely black mask (such as an inverted one) is refused."""
    Image.fromarray(np.zeros((90, 160), np.uint8)).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match="entirely black; usable pixels must be white"):
        load_mask(tmp_path / "mask.png", 160, 90)


def test_thermal_and_12_bit_photos_are_refused(shared_cases: Path) -> None:
    """Photos that would keep only 3 to 16 grey levels are refused with the range they use."""
    folder = shared_cases / "input" / "12-sixteen-bits-few-used"
    for name in ("gray12in16.png", "thermal14.tif"):
        with pytest.raises(InputError, match=r"uses only values"):
            decode_photo(folder / name)
