"""The section on photogrammetry shows what the map, its lenses and its evaluations hold."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.area.area import Area
from spn_data.colmap.model import read_map
from spn_data.errors import FormatError
from spn_data.geometry.pose import Poses
from spn_data.inputs.area_labels import read_labelled_area
from spn_data.pipeline.area_photogrammetry import photogrammetry_of
from spn_data.report.flight_charts import control_residuals, errors_over_time
from spn_data.report.photogrammetry import photogrammetry
from spn_data.report.photogrammetry_facts import Photogrammetry
from spn_data.report.pictures import COARSE, TRACK, RunEstimates
from tests.worlds import report_data


@pytest.fixture(scope="module")
def facts(finished_area: Path) -> Photogrammetry:
    """Return the facts of a reconstructed area."""
    area = Area(finished_area)
    return photogrammetry_of(area, read_labelled_area(area))


def test_reprojection_errors_are_those_of_the_model(
    finished_area: Path, facts: Photogrammetry
) -> None:
    """Number and RMS of the errors are those of COLMAP's model, in the area's own frame."""
    _, seen, _ = read_map(finished_area / "2-model")
    (lens,) = facts.lenses
    assert lens.errors is not None
    lengths = np.linalg.norm(seen.residuals_px, axis=1)
    assert len(lens.errors.errors_px) == len(lengths)
    assert lens.errors.rms_px == pytest.approx(float(np.sqrt((lengths**2).mean())), rel=1e-4)
    assert facts.track_lengths.sum() == len(lengths)


def test_the_lens_has_the_stored_sigma_and_correlations(facts: Photogrammetry) -> None:
    """A reconstruction stores sigma and correlations of its lens, and the section shows them."""
    (lens,) = facts.lenses
    calibration = lens.calibration
    assert calibration is not None
    assert {"f", "k1", "cx", "cy"} <= set(calibration.estimated)
    sigma = dict(zip(calibration.estimated, calibration.sigma.tolist(), strict=True))
    assert 0 < sigma["f"] < 0.05 * lens.camera.focal_px[0]
    row = calibration.estimated.index("f")
    assert calibration.correlation[row, row] == pytest.approx(1, abs=1e-3)
    html = photogrammetry(replace(report_data.area(), photogrammetry=facts))
    assert f"<td>{sigma['f']:.2g} px</td>" in html
    assert "Nothing is stored" not in html


def damaged(finished_area: Path, tmp_path: Path, **changes: object) -> Area:
    """Return a copy of the area whose lens has changed counts; None removes one."""
    shutil.copytree(finished_area, tmp_path / "area")
    path = tmp_path / "area" / "2-model" / "stage.json"
    record = json.loads(path.read_text())
    (camera,) = record["counts"]["cameras"].values()
    for name, value in changes.items():
        camera.pop(name)
        if value is not None:
            camera[name] = value
    path.write_text(json.dumps(record))
    return Area(tmp_path / "area")


def test_a_lens_without_stored_sigma_is_named(finished_area: Path, tmp_path: Path) -> None:
    """An area of an earlier version shows no sigma, and the page says what to do."""
    labelled = read_labelled_area(Area(finished_area))
    found = photogrammetry_of(damaged(finished_area, tmp_path, sigma=None), labelled)
    assert found.lenses[0].calibration is None
    html = photogrammetry(replace(report_data.area(), photogrammetry=found))
    assert "Nothing is stored for flight1" in html


@pytest.mark.parametrize(
    "changes",
    [
        {"sigma": [1.0]},
        {"sigma": [-1.0, 1.0]},
        {"correlation": [[1.0, 7.0], [7.0, 1.0]]},
        {"estimated": ["f", "z"]},
    ],
)
def test_a_damaged_calibration_is_refused(
    finished_area: Path, tmp_path: Path, changes: dict[str, object]
) -> None:
    """Sizes, signs, correlations and names that no lens has are refused with the camera."""
    labelled = read_labelled_area(Area(finished_area))
    with pytest.raises(FormatError, match="the calibration of camera 'flight1' cannot be read"):
        photogrammetry_of(damaged(finished_area, tmp_path, **changes), labelled)


def test_the_section_has_a_chart_for_each_fact(facts: Photogrammetry) -> None:
    """The section of a complete area has all charts, well-formed, without colours that a theme lacks."""
    data = replace(report_data.area(), photogrammetry=facts)
    html = photogrammetry(data)
    titles = re.findall(r"<figure[^>]*><h3>([^<]+)</h3>", html)
    assert {"Reprojection errors", "Track lengths", "Error ellipses of camera positions"} <= set(
        titles
    )
    assert {"Vertical residuals of GNSS", "Precision along the mapping flights"} <= set(titles)
    assert not re.search(r"\b(nan|inf)\b", html)
    assert '"#ffffff"' not in html
    assert facts.overlap is None
    assert "No overlap map: the map has too few points on level ground" in html


def test_runs_are_compared_over_the_time_of_a_flight() -> None:
    """Each method has a line in each chart, and the legend counts frames and failures."""
    frames = report_data.area().frames
    names = frames.names[frames.sequences == "medium"]
    errors = np.linspace(1, 3, len(names))
    lost = np.where(np.arange(len(names)) < 3, np.nan, 0.01)
    poses, reasons = Poses.unknown(len(names)), np.full(len(names), "")
    methods = [
        RunEstimates("one", COARSE, names, poses, errors, errors, reasons),
        RunEstimates("two", TRACK, names, poses, lost, lost, reasons),
    ]
    position, rotation = errors_over_time(frames, "medium", methods, "m")
    assert f"one: {len(names)} frames, median 2" in position
    assert f"two, fixes: {len(names) - 3} frames, median 0.01, 3 without a pose" in position
    assert "rotation error (deg)" in rotation
    assert errors_over_time(frames, "flight1", methods, "m") == []


def test_surveyed_points_without_a_height_are_not_drawn() -> None:
    """Check points are apart from control points; a residual that is unknown is left out."""
    from spn_data.georegistration.control import PointResidual

    points = [
        PointResidual("a", "control", 4, (0.0, 0.0, 0.02), (0.1, 0.1, 0.03), 0.5),
        PointResidual("b", "check", 4, (0.0, 0.0, -0.05), (0.1, 0.1, 0.03), 0.5),
        PointResidual("c", "check", 1, (np.nan,) * 3, (np.nan,) * 3, np.nan),
    ]
    drawn = control_residuals(points)
    assert "1 control points: RMSE 0.020 m" in drawn
    assert "1 check points: RMSE 0.050 m" in drawn
    assert control_residuals(points[2:]) == ""
