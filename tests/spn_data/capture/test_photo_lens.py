"""Tests of the focal length that the metadata of photos state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spn_data.capture.photo_lens import SENSORS_MM, stated_focal
from spn_data.capture.photos import read_headers
from spn_data.telemetry.exif import PhotoMetadata, read_photo

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
PHOTO = PhotoMetadata(Path("a.jpg"), 4000, 3000)
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><r:RDF xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<r:Description xmlns:d="http://www.dji.com/drone-dji/1.0/" d:CalibratedFocalLength="3666.67" '
    'd:CalibratedOpticalCenterX="2736.0" d:CalibratedOpticalCenterY="1824.0"/></r:RDF></x:xmpmeta>'
)


@pytest.mark.parametrize(
    ("name", "focal_px", "near_px"),
    [
        ("photos-two-passes/DJI_0054.JPG", 468.1, 475.0),
        ("photos-dji-xmp/DJI_0018.JPG", 1166.9, 1160.0),
    ],
)
def test_real_photos_state_their_focal_length(name: str, focal_px: float, near_px: float) -> None:
    """Photos of 4:3 and 16:9 crops have the focal length of the drone's sensor, near the estimated one."""
    if not (DATA / name).exists():
        pytest.skip(f"{DATA} holds no real photos")
    stated, note = read_headers([DATA / name]).focal(0)
    assert stated is not None
    assert note == ""
    assert stated.focal_px == pytest.approx(focal_px, abs=0.1)
    assert stated.source == "the sensor of FC300S"
    assert abs(stated.focal_px / near_px - 1) < 2 * stated.sigma
    assert 0.02 < stated.sigma < 0.025


def test_the_tags_of_a_resized_photo_are_read(tmp_path: Path) -> None:
    """Pixel density and calibration are of the original size, which tags or the optical centre tell."""
    exif = Image.Exif()
    exif[272] = "unknown"
    exif.get_ifd(0x8769).update(
        {37386: 8.8, 41989: 24, 41486: 5472 / 13.2 * 10, 41488: 3, 40962: 5472, 40963: 3648}
    )
    path = tmp_path / "a.jpg"
    Image.new("RGB", (1368, 912)).save(path, exif=exif, xmp=XMP.encode())
    photo = read_photo(path)
    assert photo.original_size == (5472, 3648)
    assert photo.focal_plane_px_per_mm == pytest.approx(5472 / 13.2)
    assert photo.calibrated_center_px == (2736.0, 1824.0)
    stated, note = stated_focal(photo)
    assert (stated and stated.source, note) == ("FocalPlaneXResolution", "")
    assert stated.focal_px == pytest.approx(8.8 / 13.2 * 1368)
    without = replace(photo, focal_plane_px_per_mm=np.nan, original_size=(1368, 912))
    stated, note = stated_focal(without)  # a program wrote the new size into the tags
    assert (stated and stated.source, note) == ("CalibratedFocalLength", "")
    assert stated.focal_px == pytest.approx(3666.67 / 4)


@pytest.mark.parametrize(
    ("size", "shortest", "longest"),
    [
        ((4000, 3000), 24 / 36, 24 / 36 * 1.083),
        ((4000, 2250), 0.636, 0.693),
        ((3000, 2000), 0.667, 0.693),
    ],
)
def test_a_35_mm_equivalent_covers_what_it_may_mean(
    size: tuple[int, int], shortest: float, longest: float
) -> None:
    """The sigma of an equivalent covers diagonals and widths, of the photo and of the whole sensor."""
    for width, height in (size, size[::-1]):
        stated, _ = stated_focal(replace(PHOTO, width=width, height=height, focal_35mm=24.0))
        assert stated is not None
        for reading in (shortest, longest):
            assert abs(np.log(stated.focal_px / (reading * max(size)))) < 1.1 * stated.sigma
        assert stated.sigma < 0.07


def test_statements_that_disagree_are_told() -> None:
    """A resized photo that kept its pixel density contradicts the equivalent: a note, the larger sigma."""
    resized = replace(
        PHOTO, width=1000, height=750, focal_mm=4.5, focal_plane_px_per_mm=625.0, focal_35mm=24.0
    )
    stated, note = stated_focal(resized)
    assert stated is not None
    assert stated.source == "the 35 mm equivalent"
    assert stated.sigma > 0.04
    assert "2812 px by FocalPlaneXResolution, but 693 px by the 35 mm equivalent" in note
    assert stated_focal(replace(resized, focal_35mm=np.nan))[0].source == "FocalPlaneXResolution"
    for value in (0.0, 1e-9, 1e30, np.nan):
        assert stated_focal(replace(PHOTO, calibrated_focal_px=value)) == (None, "")


@pytest.mark.parametrize(
    ("model", "focal_mm", "equivalent_mm"),
    [
        ("FC300S", 3.61, 20), ("FC330", 3.61, 20), ("FC220", 4.73, 28), ("FC2103", 4.5, 24),
        ("FC7203", 4.49, 24), ("FC7303", 4.49, 24), ("FC3170", 4.5, 24), ("FC3582", 6.72, 24),
        ("FC6310", 8.8, 24), ("FC6510", 8.8, 24), ("L1D-20c", 10.26, 28), ("L2D-20c", 12.29, 24),
        ("M3E", 12.29, 24), ("FC6520", 15, 30), ("ZenmuseP1", 35, 35),
    ],
)  # fmt: skip
def test_the_sensors_agree_with_the_published_equivalents(
    model: str, focal_mm: float, equivalent_mm: float
) -> None:
    """Focal length and sensor of each drone give its published 35 mm equivalent within 2 sigma."""
    width, height = SENSORS_MM[model]
    photo = replace(
        PHOTO, width=4000, height=round(4000 * height / width), model=model, focal_mm=focal_mm
    )
    stated, note = stated_focal(replace(photo, focal_35mm=equivalent_mm))
    assert stated is not None
    assert (stated.source, note) == (f"the sensor of {model}", "")
    assert stated.focal_px == pytest.approx(focal_mm / width * 4000, rel=0.001)
