"""Kinds of the counts in stage.json, by stage: what reads them need not expect anything else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from spn_data.area.names import EVALUATION, FRAMES, GEO, MODEL, SPLIT, TRACKED
from spn_data.storage.json_files import kind_of

# Kinds of single values. A list of one kind holds any number of it, a longer one exactly these; an object
# with the name "*" holds any names, a name that ends with "?" may be missing, and others are not read.
COUNT, KNOWN, NUMBER, TEXT, FLAG = (
    "a count",
    "a number",
    "a number or null",
    "text",
    "true or false",
)
_MAX_COUNT = 10**15
_COUNTS_BY_NAME = {"*": COUNT}
_OF_REGISTERED = ("focal_px", "fov_deg", "inliers", "error_px", "sigma", "sigma_deg")

_KINDS: dict[str, dict[str, Any]] = {
    FRAMES: dict.fromkeys(("chosen", "candidates", "sequences", "with_fix", "unreadable"), COUNT),
    MODEL: {
        **dict.fromkeys(("registered", "frames", "points", "observations"), COUNT),
        **dict.fromkeys(("pairs_verified", "pairs_tried"), COUNT),
        **dict.fromkeys(("mean_error_px", "viewing_distance"), KNOWN),
        "contradicted": FLAG,
        "cameras": {
            "*": {
                **{"focal_px": KNOWN, "fov_deg": KNOWN, "model?": TEXT, "params?": [KNOWN]},
                **{"focal_doubt_px?": KNOWN, "focal_error_px?": NUMBER},
                **{"estimated?": [TEXT], "sigma?": [KNOWN], "correlation?": [[KNOWN]]},
                **{"principal_point_sigma_px?": [KNOWN]},
            },
        },
        "shutter": [{"sequence": TEXT, "rolls?": FLAG}],
        "submodels": [COUNT],
    },
    GEO: {
        **dict.fromkeys(("fixes", "frames", "outliers", "held_out_blocks"), COUNT),
        **dict.fromkeys(("horizontal_rmse_m", "vertical_rmse_m", "ce90_m", "le90_m"), NUMBER),
        **dict.fromkeys(("held_out_horizontal_rmse_m", "held_out_vertical_rmse_m"), NUMBER),
        **dict.fromkeys(("sigma_horizontal_m", "sigma_vertical_m", "sigma_tilt_deg"), NUMBER),
        **dict.fromkeys(("sigma_heading_deg", "sigma_scale", "effective_fixes"), NUMBER),
        "observations": [TEXT],
        "origin": [KNOWN, KNOWN, KNOWN],
        "height_reference": TEXT,
    },
    EVALUATION: {
        **dict.fromkeys(("registered", "frames"), COUNT),
        **dict.fromkeys(_OF_REGISTERED, NUMBER),
        "failed": _COUNTS_BY_NAME,
        "gnss": {
            "contradicts": FLAG,
            **dict.fromkeys(("offset_e_m", "offset_n_m", "scatter_h_m"), KNOWN),
            "offset_u_m": NUMBER,
            "far?": COUNT,
        },
    },
    TRACKED: {
        **dict.fromkeys(("registered", "frames", "registered_of_all", "of_all"), COUNT),
        "failed": _COUNTS_BY_NAME,
    },
    SPLIT: {
        "groups": _COUNTS_BY_NAME,
        "audit": _COUNTS_BY_NAME,
        "image_px": [[COUNT, COUNT]],
        **dict.fromkeys(("left_out", "training_points"), COUNT),
        "optimistic": FLAG,
    },
}
_MAY_BE_NULL = ("gnss",)


def check_counts(stage: str, counts: Mapping[str, Any]) -> None:
    """Check the kinds of the counts of a stage; missing ones are reported when they are used.

    Parameters
    ----------
    stage : str
        Name of the stage, such as `4-eval/north`.
    counts : mapping
        Its counts as read from JSON.

    Raises
    ------
    TypeError
        If a count is of another kind, negative, not finite or larger than any real one.
    """
    kinds = _KINDS[stage.partition("/")[0]]
    for name in kinds.keys() & counts.keys():
        if counts[name] is not None or name not in _MAY_BE_NULL:
            _check(f"the count {name!r}", counts[name], kinds[name])
    if counts.get("registered"):
        for name in _OF_REGISTERED:
            if name in kinds and name in counts:
                _check(f"the count {name!r}", counts[name], KNOWN)


def _check(name: str, value: Any, kind: Any) -> None:
    if isinstance(kind, str):
        if not _is(value, kind):
            found = f"{value!r:.40}" if isinstance(value, int | float) else kind_of(value)
            raise TypeError(f"{name} is {found} instead of {kind}")
        return
    if type(value) is not type(kind):
        raise TypeError(f"{name} is {kind_of(value)} instead of {kind_of(kind)}")
    if isinstance(kind, list):
        if len(kind) > 1 and len(value) != len(kind):
            raise TypeError(f"{name} has {len(value)} items instead of {len(kind)}")
        for k, item in enumerate(value):
            _check(name, item, kind[k % len(kind)])
    elif "*" in kind:
        for item in value.values():
            _check(name, item, kind["*"])
    else:
        for part, of_part in kind.items():
            if part.rstrip("?") in value:
                _check(f"{name}: {part.rstrip('?')!r}", value[part.rstrip("?")], of_part)
            elif not part.endswith("?"):
                raise TypeError(f"{name} has no {part!r}")


def _is(value: Any, kind: str) -> bool:
    if kind in (TEXT, FLAG):
        return isinstance(value, str if kind == TEXT else bool)
    if value is None:
        return kind == NUMBER
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return False
    return kind != COUNT or (isinstance(value, int) and 0 <= value <= _MAX_COUNT)
