"""Records of an area with any value replaced by one of another kind give one line, and never a traceback."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import tomli_w
from spn_cli import show, show_labels, split

from spn_data.area.area import Area
from spn_data.area.facts import read_facts
from spn_data.area.names import (
    EVALUATION,
    FRAMES,
    GEO,
    GEO_FIT,
    MODEL,
    REGISTRATION,
    SPLIT,
    TRACKED,
)
from spn_data.errors import FormatError, SpnError
from spn_data.geometry.pose import Similarity
from spn_data.georegistration.result import GeoFit
from spn_data.inputs.area_labels import read_geo, read_written_world
from spn_data.storage.stage_record import StageRecord

NORTH = f"{EVALUATION}/north"
GNSS = {
    "contradicts": False,
    "offset_e_m": 0.1,
    "offset_n_m": 0.2,
    "offset_u_m": 0.3,
    "scatter_h_m": 0.1,
}
SIGMAS = (
    "sigma_horizontal_m",
    "sigma_vertical_m",
    "sigma_tilt_deg",
    "sigma_heading_deg",
    "sigma_scale",
)
RESIDUALS = ("horizontal_rmse_m", "vertical_rmse_m", "ce90_m", "le90_m")
HELD_OUT = ("held_out_horizontal_rmse_m", "held_out_vertical_rmse_m")
FIT = {"frames": 2, "fixes": 2, "outliers": 0, "effective_fixes": 1.0, "gravity_rms_deg": 0.1}
BLOCKS = {"folds": 1, "frames": 2} | dict.fromkeys(
    ("horizontal_median_m", "horizontal_rmse_m", "vertical_median_m", "vertical_rmse_m"), 0.1
)
COUNTS: dict[str, dict[str, Any]] = {
    FRAMES: {"chosen": 3, "candidates": 9, "sequences": 1, "with_fix": 3, "unreadable": 1},
    MODEL: {
        **{"registered": 3, "frames": 3, "points": 99, "observations": 300, "mean_error_px": 0.3},
        **{"pairs_verified": 3, "pairs_tried": 3, "submodels": [3]},
        "cameras": {
            "a": {"focal_px": 200.0, "fov_deg": 70.0, "model": "RADIAL", "params": [200.0]}
        },
        "shutter": [{"sequence": "a", "rolls": False}],
    },
    GEO: {
        **{"fixes": 3, "frames": 3, "outliers": 0, "held_out_blocks": 0},
        **dict.fromkeys((*SIGMAS, *RESIDUALS, *HELD_OUT), 0.1),
        **{"observations": ["fixes"], "origin": [49.0, 8.0, 0.0], "height_reference": "takeoff"},
    },
    NORTH: {
        **{"registered": 3, "frames": 4, "failed": {"ambiguous": 1}, "gnss": GNSS},
        **dict.fromkeys(("focal_px", "fov_deg", "inliers", "error_px", "sigma", "sigma_deg"), 1.0),
    },
    f"{TRACKED}/north": {
        **{"registered": 3, "frames": 4, "failed": {"lost": 1}, "registered_of_all": 6, "of_all": 8}
    },
    SPLIT: {
        **{"groups": {"train": 2}, "audit": {"pass": 3}, "image_px": [[480, 270]]},
        **{"left_out": 1, "training_points": 9, "optimistic": False},
    },
}
GEOREGISTRATION = {
    "version": 1,
    "origin": {"lat_deg": 49.0, "lon_deg": 8.0, "alt_m": 0.0, "height_reference": "takeoff"},
    "world_from_model": {
        **{"scale": 1.0, "rotation": [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]},
        "translation_m": [0.0, 0.0, 0.0],
    },
    "vertical_offsets_m": {"a": 0.1},
    "residuals_m": [[0.1, 0.1, 0.1]],
    "outlier": [False],
    "gravity_deg": [[0.1, 0.1]],
    "gimbal_bias_deg": {"a": [0.1, 0.1, 0.1]},
    "noise_m": {"horizontal": [0.1, 0.1]},
    "uncertainty": {
        **dict.fromkeys(("horizontal_m", "vertical_m", "tilt_deg", "heading_deg", "scale"), 0.1),
        **{"covariance": [[0.1] * 7] * 7, "middle_m": [0.0, 0.0, 0.0]},
    },
    "held_out_blocks": BLOCKS,
    "held_out_flights": BLOCKS,
    "summary": FIT | dict.fromkeys(RESIDUALS, 0.1),
    "observations": ["fixes"],
    "notes": ["a note"],
}
SHOWN: dict[str, Callable[[StageRecord], None]] = {
    FRAMES: show.frames,
    MODEL: show.model,
    GEO: show.georegistration,
    NORTH: lambda record: show_labels.evaluation(record, "m"),
    f"{TRACKED}/north": show_labels.tracked,
    SPLIT: split._show,
}
DEEP: list[Any] = []
for _ in range(60):
    DEEP = [DEEP]
OTHERS: dict[str, Any] = {
    **{"text": "five", "negative": -1, "huge": 10**90, "nan": float("nan"), "null": None},
    **{"flag": True, "list": [], "object": {}, "deep": DEEP},
}


def record_of(stage: str) -> dict[str, Any]:
    """Return the content of a complete stage.json."""
    return {
        **{
            "version": 1,
            "stage": stage,
            "options": {"n": 1},
            "inputs": {"a.mp4": "f"},
            "upstream": {},
        },
        **{"counts": COUNTS[stage], "seconds": {"all": 1.0}, "cpu_seconds": {"all": 1.0}},
        **{
            "notes": ["a note"],
            "versions": {"numpy": "2"},
            "finished": "2026-01-01T00:00:00+00:00",
        },
    }


def nodes(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield path and value of everything in a document except its root."""
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        yield (*path, key), item
        if isinstance(item, dict | list):
            yield from nodes(item, (*path, key))


def changed(document: Any, path: tuple[Any, ...], to: Any) -> Any:
    """Return a copy with one value replaced."""
    new = at = copy.deepcopy(document)
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = to
    return new


def kind(value: Any) -> str:
    """Return the JSON kind of a value."""
    return "number" if type(value) in (int, float) else type(value).__name__


def refusal(read: Callable[[], object]) -> str:
    """Return the message with which a document is refused, or "" if it is read."""
    try:
        read()
    except SpnError as error:
        return str(error)
    return ""


def check_all(
    document: dict[str, Any], write: Callable[[Any], None], read: Callable[[], object]
) -> int:
    """Read a document with each value replaced by each other kind; return how many were refused.

    A value of another kind that is not null must be refused; any refusal is one line.
    """
    write(document)
    read()
    refused = 0
    for path, value in nodes(document):
        for name, other in OTHERS.items():
            write(changed(document, path, other))
            is_other = kind(other) != kind(value) and other is not None
            told = refusal(read)
            assert "\n" not in told, (path, name)
            assert told or not is_other or "options" in path, (path, name)
            refused += bool(told)
    return refused


@pytest.mark.parametrize("stage", list(COUNTS))
def test_every_value_of_stage_json_has_its_kind(stage, tmp_path):
    """No value of a record with another kind reaches what shows it."""
    area = Area(tmp_path)
    path = area.folder(stage) / "stage.json"
    path.parent.mkdir(parents=True)
    refused = check_all(
        record_of(stage),
        lambda document: path.write_text(json.dumps(document)) and None,
        lambda: SHOWN[stage](area.record(stage)),
    )
    assert refused > 100


@pytest.mark.parametrize("count", [-1, 1.5, 10**20, True, "3", None])
def test_a_count_is_a_whole_number(tmp_path, count):
    """Counts are whole, not negative and of a size that can be; the message says which one is not."""
    path = Area(tmp_path).folder(MODEL) / "stage.json"
    path.parent.mkdir()
    path.write_text(json.dumps(changed(record_of(MODEL), ("counts", "points"), count)))
    with pytest.raises(
        FormatError, match=r"2-model/stage\.json: .*the count 'points' is .* instead of a count"
    ):
        Area(tmp_path).record(MODEL)


def test_every_value_of_geo_json_has_its_kind(tmp_path):
    """No value of a georegistration with another kind is taken for a number, a flag or a note."""
    area = Area(tmp_path)
    path = area.folder(GEO) / GEO_FIT
    path.parent.mkdir()
    write = lambda document: path.write_text(json.dumps(document)) and None  # noqa: E731
    assert check_all(GEOREGISTRATION, write, lambda: read_geo(area)) > 300
    write(GEOREGISTRATION)
    found = read_geo(area)
    assert isinstance(found, GeoFit)
    assert found.to_json()["summary"]["fixes"] == 2


def test_every_value_of_registration_json_has_its_kind(tmp_path):
    """No value of another kind is taken for the frame that labels were written in."""
    path = tmp_path / REGISTRATION
    document = {"version": 1, "world_from_model": Similarity.identity().to_json()}
    write = lambda document: path.write_text(json.dumps(document)) and None  # noqa: E731
    assert check_all(document, write, lambda: read_written_world(path)) > 50


def test_every_value_of_area_toml_has_its_kind(tmp_path):
    """No value of another kind is taken for a source, a sequence or an option."""
    path = tmp_path / "area.toml"
    document = {"version": 1, "sources": ["a.mp4"], "evaluation": {"north": "b.mp4"}}
    document |= {"expect_low": ["north"], "options": {"fov": ["72"], "sources": ["x"]}}

    def write(document: Any) -> None:
        try:
            path.write_text(tomli_w.dumps(document))
        except TypeError:  # there is no null in TOML
            path.write_text("version = ")

    assert check_all(document, write, lambda: read_facts(path)) > 20
