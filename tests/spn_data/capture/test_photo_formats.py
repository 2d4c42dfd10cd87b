"""Photo formats: HEIC and DNG stand upright, twins count once, sizes are bounded, BMP and WebP are read."""

from __future__ import annotations

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spn_data.capture.photos import decode_photo, decode_photo_gray, read_headers
from spn_data.capture.sources import discover
from spn_data.errors import InputError
from spn_data.media import photo_file
from spn_data.telemetry.exif import read_photo

# EXIF orientation -> corner where the stored upper-left one ends up (right, lower).
CORNERS = {1: (0, 0), 2: (1, 0), 3: (1, 1), 4: (0, 1), 5: (0, 0), 6: (1, 0), 7: (1, 1), 8: (0, 1)}
XMP = (
    b"<x:xmpmeta xmlns:x='adobe:ns:meta/'><r:RDF "
    b"xmlns:r='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><r:Description "
    b"xmlns:d='http://www.dji.com/drone-dji/1.0/' d:RelativeAltitude='+39.80'/></r:RDF></x:xmpmeta>"
)


def quarter(width: int = 320, height: int = 240) -> np.ndarray:
    """Create a dark image (H, W) whose upper-left quarter is bright."""
    image = np.full((height, width), 30, np.uint8)
    image[: height // 2, : width // 2] = 200
    return image


def write_heic(path: Path, orientation: int = 1) -> Path:
    """Write a HEIC with its rotation as HEIF states it, and the same in EXIF, as phones do."""
    heif = pytest.importorskip("pillow_heif", reason="needs the extra heic")
    heif.register_heif_opener()
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 30.0, 36.0), 3: "W", 4: (20.0, 15.0, 36.0)})
    image = Image.fromarray(quarter()).convert("RGB")
    image.save(path, "HEIF", quality=90, exif=exif.tobytes(), xmp=XMP)
    turned = any(box in path.read_bytes() for box in (b"irot", b"imir"))
    assert turned == (orientation > 1)
    return path


def _directory(entries: list[tuple[int, str, tuple]], at: int) -> bytes:
    """Pack a TIFF directory that begins at byte `at`; kinds are a, B, H, I, R (rational), S (signed)."""
    codes = {"B": 1, "a": 2, "H": 3, "I": 4, "R": 5, "S": 10}
    head, rest = struct.pack("<H", len(entries)), b""
    for tag, kind, values in entries:
        if kind == "a":
            data = values[0].encode() + b"\0"
        elif kind in "RS":
            data = b"".join(struct.pack("<II" if kind == "R" else "<ii", *pair) for pair in values)
        else:
            data = struct.pack(f"<{len(values)}{kind}", *values)
        count = len(data) if kind == "a" else len(values)
        if len(data) > 4:
            place = struct.pack("<I", at + 6 + 12 * len(entries) + len(rest))
            rest += data + bytes(len(data) % 2)
        else:
            place = data.ljust(4, b"\0")
        head += struct.pack("<HHI", tag, codes[kind], count) + place
    return head + bytes(4) + rest


def write_dng(path: Path, orientation: int = 1, claim: int | None = None) -> Path:
    """Write a DNG of a linear 16-bit sensor with GNSS and XMP; `claim` is a false width and height."""
    values = quarter().astype("<u2") * 256
    height, width = values.shape
    data = values.tobytes()
    gps = _directory(
        [
            (1, "a", ("N",)),
            (2, "R", ((48, 1), (30, 1), (36, 1))),
            (3, "a", ("W",)),
            (4, "R", ((20, 1), (15, 1), (36, 1))),
        ],
        8 + len(data),
    )
    unit = tuple((int(i == j), 1) for i in range(3) for j in range(3))
    main = _directory(
        [
            (254, "I", (0,)),
            (256, "I", (claim or width,)),
            (257, "I", (claim or height,)),
            (258, "H", (16,)),
            (259, "H", (1,)),
            (262, "H", (32803,)),
            (271, "a", ("Maker",)),
            (272, "a", ("Camera",)),
            (273, "I", (8,)),
            (274, "H", (orientation,)),
            (277, "H", (1,)),
            (278, "I", (claim or height,)),
            (279, "I", (len(data),)),
            (700, "B", tuple(XMP)),
            (33421, "H", (2, 2)),
            (33422, "B", (0, 1, 1, 2)),
            (34853, "I", (8 + len(data),)),
            (50706, "B", (1, 4, 0, 0)),
            (50708, "a", ("Maker Camera",)),
            (50717, "I", (65535,)),
            (50721, "S", unit),
            (50728, "R", ((1, 1),) * 3),
            (50778, "H", (21,)),
        ],
        8 + len(data) + len(gps),
    )
    start = b"II*\0" + struct.pack("<I", 8 + len(data) + len(gps))
    path.write_bytes(start + data + gps + main)
    return path


def write(path: Path, orientation: int = 1) -> Path:
    """Write a HEIC or DNG by its suffix."""
    if path.suffix == ".dng":
        pytest.importorskip("rawpy", reason="needs the extra raw")
        return write_dng(path, orientation)
    return write_heic(path, orientation)


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
@pytest.mark.parametrize("orientation", sorted(CORNERS))
def test_orientation_is_applied_once(tmp_path: Path, suffix: str, orientation: int) -> None:
    """HEIC and DNG stand upright in colour, in grey, in a preview and in the header."""
    path = write(tmp_path / f"a{suffix}", orientation)
    right, lower = CORNERS[orientation]
    size = (240, 320) if orientation >= 5 else (320, 240)
    assert read_headers([path]).sizes.tolist() == [list(size)]
    for image in (
        decode_photo(path)[..., 1],
        decode_photo_gray(path, max_width=640),
        decode_photo_gray(path, max_width=60),
    ):
        height, width = image.shape
        assert (width > height) == (size[0] > size[1])
        bright = image > image.mean()
        y, x = np.nonzero(bright)
        assert (x.mean() > width / 2, y.mean() > height / 2) == (right, lower)
        assert 0.2 < bright.mean() < 0.3


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_tags_of_heic_and_dng(tmp_path: Path, suffix: str) -> None:
    """Position, maker and XMP are read from HEIC and DNG, with the orientation already applied."""
    photo = read_photo(write(tmp_path / f"a{suffix}", 6))
    assert (photo.lat_deg, photo.lon_deg) == pytest.approx((48.51, -20.26))
    assert (photo.make, photo.relative_altitude_m) == ("Maker", 39.8)
    assert (photo.width, photo.height, photo.orientation) == (240, 320, 1)
    assert photo.notes == ()


def test_brightness_of_a_dng_does_not_follow_its_content(tmp_path: Path) -> None:
    """The dark part of a DNG is equally dark whether or not the rest of the photo is bright."""
    path = write(tmp_path / "a.dng")
    dark = write(tmp_path / "b.dng")
    data = bytearray(dark.read_bytes())
    data[8 : 8 + 2 * 320 * 240] = np.full(320 * 240, 30 * 256, "<u2").tobytes()
    dark.write_bytes(data)
    assert abs(int(decode_photo(path)[200, 200, 0]) - int(decode_photo(dark)[200, 200, 0])) <= 1


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_damaged_heic_and_dng_are_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    """Cut and flipped files give an InputError of one line, or are read; nothing else is raised."""
    whole = write(tmp_path / f"a{suffix}").read_bytes()
    path = tmp_path / f"b{suffix}"
    rng = np.random.default_rng(1)
    errors = []
    for trial in range(40):
        data = bytearray(whole[: int(rng.integers(len(whole)))] if trial % 2 else whole)
        for place in rng.integers(0, 400, 6).tolist() if trial % 2 == 0 else ():
            data[-place - 1 if suffix == ".dng" else place] = int(rng.integers(256))
        path.write_bytes(bytes(data))
        try:
            read_photo(path)
            decode_photo(path)
        except InputError as error:
            errors.append(str(error))
    assert len(errors) > 10
    assert not any("\n" in error for error in errors)


def test_a_dng_that_claims_a_billion_pixels_is_refused(tmp_path: Path) -> None:
    """The size in the header of a DNG is checked before its pixels are unpacked."""
    pytest.importorskip("rawpy", reason="needs the extra raw")
    path = write_dng(tmp_path / "a.dng", claim=32_000)
    with pytest.raises(InputError, match="claims more than 300 megapixels"):
        decode_photo(path)
    assert "claims more than 300 megapixels" in read_headers([path]).problem[0]


def test_large_mapping_photos_are_read(tmp_path: Path) -> None:
    """Headers of 151 and 280 megapixels, of real cameras, are accepted; Pillow's limit is unchanged."""
    before = Image.MAX_IMAGE_PIXELS
    Image.new("1", (64, 64)).save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    for size in [(14_204, 10_652), (20_150, 13_895)]:
        header = b"IHDR" + struct.pack(">II", *size) + data[24:29]
        (tmp_path / "b.png").write_bytes(
            data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
        )
        assert (read_photo(tmp_path / "b.png").width, read_photo(tmp_path / "b.png").height) == size
    assert before == Image.MAX_IMAGE_PIXELS


@pytest.mark.parametrize(
    ("name", "package", "extra"), [("a.heic", "pillow_heif", "heic"), ("a.dng", "rawpy", "raw")]
)
def test_a_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    """Without the package of a format, its photos end the command with the pip command."""
    (tmp_path / name).write_bytes(b"\0\0\0\0ftypheic")
    monkeypatch.setitem(sys.modules, package, None)
    said = rf"{name}: reading .* pip install 'squeezeposenet-toolkit\[{extra}\]'"
    with pytest.raises(InputError, match=said):
        discover(tmp_path)


def test_twins_of_a_photo_count_once(tmp_path: Path) -> None:
    """A DNG or HEIC beside a JPEG of the same name is left out with a note; one alone is a photo."""
    pytest.importorskip("rawpy", reason="needs the extra raw")
    pytest.importorskip("pillow_heif", reason="needs the extra heic")
    for name in ("1.DNG", "1.JPG", "2.heic", "2.jpg", "3.dng", "4.JPG"):
        (tmp_path / name).touch()
    found = discover(tmp_path)
    assert [p.name for p in found.sources[0].parts] == ["1.JPG", "2.jpg", "3.dng", "4.JPG"]
    assert found.ignored == (
        (Path("1.DNG"), "the same photo as 1.JPG, which is used"),
        (Path("2.heic"), "the same photo as 2.jpg, which is used"),
    )


def test_raw_photos_are_called_so(tmp_path: Path) -> None:
    """RAW photos that are not read are ignored under their true name, with the remedy."""
    for name in ("1.NEF", "2.cr2", "3.ARW", "4.raf", "5.rw2", "6.orf"):
        (tmp_path / name).touch()
    with pytest.raises(
        InputError, match=r"6 other files, 6 of them RAW photos: convert them to DNG"
    ):
        discover(tmp_path)
    with pytest.raises(InputError, match=r"1\.NEF: is a RAW photo that is not read: convert"):
        discover(tmp_path / "1.NEF")
    (tmp_path / "a.jpg").touch()
    assert {why for _, why in discover(tmp_path).ignored} == {photo_file.RAW_REMEDY}


@pytest.mark.parametrize("suffix", [".bmp", ".webp"])
def test_bmp_and_webp_are_photos(tmp_path: Path, suffix: str) -> None:
    """BMP and WebP are found, measured and decoded like other photos."""
    path = tmp_path / f"a{suffix}"
    Image.fromarray(quarter()).convert("RGB").save(path)
    [source] = discover(tmp_path).sources
    assert read_headers(source.parts).sizes.tolist() == [[320, 240]]
    assert decode_photo(path)[20, 20].tolist() == pytest.approx([200] * 3, abs=4)
    assert decode_photo_gray(path, max_width=100).shape == (75, 100)


def test_events_of_a_folder_belong_to_its_photos(tmp_path: Path) -> None:
    """All .MRK files of a folder belong to its photos, beside the one log in it."""
    for name in ("a.JPG", "1_Timestamp.MRK", "2_Timestamp.MRK", "flight.csv"):
        (tmp_path / name).touch()
    [source] = discover(tmp_path).sources
    assert [t.name for t in source.telemetry] == [
        "1_Timestamp.MRK",
        "2_Timestamp.MRK",
        "flight.csv",
    ]
