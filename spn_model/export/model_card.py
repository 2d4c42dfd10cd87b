"""MODEL_CARD.md of a bundle: the network, its measured errors, and its limits."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from spn_data.errors import InputError
from spn_data.geometry.pose import position_text
from spn_model.evaluation.fix_files import FIX_HEADER, fix_rows
from spn_model.models.checkpoint import Checkpoint
from spn_model.onboard.bundle import FLOAT32, GRAPHS, INT8
from spn_model.pretrained.weights import by_name

if TYPE_CHECKING:
    from spn_model.export.bundle_checks import GroupErrors
    from spn_model.export.exported import ExportedBundle

_VERDICT = "Verdict"  # title of its section
_NOT_JUDGED = "Not judged yet: run `spn-model evaluate`, which completes this card."


def model_card(
    checkpoint: Checkpoint,
    made: ExportedBundle,
    facts: Mapping[str, Any],
    metrics: Mapping[str, Any] | None,
    document: Mapping[str, Any],
) -> str:
    """Return the model card as Markdown.

    metrics : evaluation of the run, as in metrics.json; if None, the card says that there is none.
    document : bundle.json, which tells whether fixes were measured with these very files.
    """
    view, model = checkpoint.view, checkpoint.model
    unit = _unit(view.units)
    parameters = sum(p.numel() for p in model.network.parameters())
    place = view.origin
    parts = [
        f"# {facts.get('run', 'Network')}",
        f"Estimates the camera pose from a single image in one area: a network of kind {model.kind} with "
        f"{parameters:,} parameters.",
        _list(
            f"Input: {view.size[0]} x {view.size[1]} px, horizontal field of view "
            + (
                "of each image"
                if view.camera is None
                else f"{view.camera.horizontal_fov_deg:.1f} deg"
            )
            + "; the onboard program renders the images of the flying camera into this view.",
            f"Output: camera centre in {unit}, orientation, 6 x 6 covariance.",
            "World: "
            + (
                "not georeferenced."
                if place is None
                else f"East, North, Up about latitude {place.lat_deg:.7f}, longitude {place.lon_deg:.7f}, "
                f"height {place.alt_m:.2f} m ({place.height_reference.value})."
            ),
            *(
                [
                    f"Offset: {position_text(view.offset)}, which the onboard program adds to the positions "
                    "that the network computes in float32."
                ]
                if any(view.offset)
                else []
            ),
            f"Data set: {view.dataset} (fingerprint).",
            *(
                f"Graph {GRAPHS[p]}: {size / 1e6:.2f} MB, {p}, SHA-256 in bundle.json."
                for p, size in made.bytes.items()
            ),
        ),
        f"## {_VERDICT}",
        _NOT_JUDGED,
        "## Errors",
        *_error_section(metrics, str(facts.get("run", "")), unit, facts.get("trained_on", ())),
        "## Fixes",
        *fix_section(_fixes_of(metrics, document)),
        "## Accuracy of the bundle",
        f"On {made.parity.images} images, the outputs of the float32 graph differ from PyTorch's by at most "
        f"{made.parity.output:.1e} of the output's largest value. Half of the poses differ by at most "
        f"{made.parity.position:.1e} {unit} and {made.parity.rotation_deg:.1e} deg, all of them by at most "
        f"{made.parity.largest_sigmas:.1e} of their own standard deviations.",
        _bundle_errors(made.errors, unit),
        "## Limits",
        _list(
            "Poses are valid only in the area that the training images show.",
            "Light, seasons and moved objects that no training image shows were not evaluated.",
            "A covariance expresses the uncertainty of views that the network knows; it does not flag every "
            "view that the network has never seen.",
            "Not certified for any use in which an error may endanger people.",
        ),
        "## Licence of the initial weights",
        _licence(checkpoint, facts),
    ]
    return "\n\n".join(parts) + "\n"


def card_with_metrics(
    card: str, metrics: Mapping[str, Any], *, run: str, trained_on: Collection[str]
) -> str:
    """Return a model card with the errors and fixes of a later evaluation of its bundle.

    metrics : as in metrics.json. trained_on : groups that the network was trained on.
    """
    unit = _unit(metrics["units"])
    card = _with_section(card, _VERDICT, [_NOT_JUDGED])
    card = _with_section(card, "Errors", _error_section(metrics, run, unit, trained_on))
    return _with_section(card, "Fixes", fix_section(metrics["fixes"]))


def card_with_verdict(card: str, parts: Iterable[tuple[str, str]]) -> str:
    """Return a model card with the verdict on its area: parts by name, one sentence or two each."""
    if f"## {_VERDICT}\n\n" not in card:  # of an earlier version
        card = card.replace("## Errors\n\n", f"## {_VERDICT}\n\n{_NOT_JUDGED}\n\n## Errors\n\n", 1)
    lines = (f"{name}: {' '.join(text.split())}" for name, text in parts)
    return _with_section(card, _VERDICT, [_list(*lines)])


def _with_section(card: str, title: str, parts: Sequence[str]) -> str:
    """Replace a section before the last one; a card without it, of an earlier version, stays as it is."""
    head, heading, rest = card.partition(f"## {title}\n\n")
    _, next_heading, tail = rest.partition("\n\n## ")
    return head + heading + "\n\n".join(parts) + next_heading + tail if tail else card


def _unit(units: str) -> str:
    return "m" if units == "m" else "units of the model"


def fix_section(fixes: Mapping[str, Any] | None) -> list[str]:
    """Return the paragraphs on the fixes of a bundle.

    fixes : as in metrics.json; None if they were not measured with this bundle.
    """
    if fixes is None or not fixes["flights"]:
        return [
            "Not measured with this bundle, so it is not to be flown yet: run `spn-model evaluate`, now that "
            "it is exported."
        ]
    return [
        "Measured by `spn-model evaluate` with this bundle, on the images of the evaluation flights of its "
        "area, through the program that flies. Coarse is the network alone, search single images, track the "
        "images one after the other. Misleading is a usable fix that is off by more than 0.5 m, 2 degrees or "
        "its protection level; in brackets the upper bound of its share, with 95 % confidence.",
        _table(FIX_HEADER, fix_rows(fixes["flights"])),
        *fixes.get("attitudes", ()),
    ]


def _fixes_of(
    metrics: Mapping[str, Any] | None, document: Mapping[str, Any]
) -> Mapping[str, Any] | None:
    """Return the fixes that were measured with the files of a bundle; None if there are none."""
    fixes = (metrics or {}).get("fixes")
    if not fixes or "landmarks" not in document:
        return None
    made = {
        "network": document["graphs"][FLOAT32]["sha256"],
        "landmarks": document["landmarks"]["sha256"],
    }
    same = all(fixes["bundle"].get(name) == digest for name, digest in made.items())
    return fixes if same else None


def int8_error_increase(errors: Sequence[GroupErrors], group: str) -> tuple[float, float] | None:
    """Return by how many percent int8 raises the median position and rotation errors of a group.

    Parameters
    ----------
    errors : sequence of GroupErrors
        Errors of all groups and precisions.
    group : str
        Name of the group.

    Returns
    -------
    tuple of float or None
        Position and rotation; NaN if not defined. None without an int8 graph.
    """
    by = {one.precision: one for one in errors if one.group == group}
    if len(by) < 2:
        return None
    before, after = by[FLOAT32], by[INT8]
    return (
        _percent(before.position, after.position),
        _percent(before.rotation_deg, after.rotation_deg),
    )


def _percent(before: float, after: float) -> float:
    if not (math.isfinite(before) and math.isfinite(after)) or before <= 0:
        return math.nan
    return 100 * (after / before - 1)


def _error_section(
    metrics: Mapping[str, Any] | None, run: str, unit: str, trained_on: Collection[str]
) -> list[str]:
    if metrics is None:
        return ["The run was not evaluated: run `spn-model evaluate`, which completes this card."]
    rows = [
        (
            f"{group} (trained on)" if group in trained_on else group,
            str(found["frames"]),
            str(found["located"]),
            *(_number(found["position"][name]) for name in ("median", "mean", "p95")),
            *(_number(found["rotation_deg"][name]) for name in ("median", "mean", "p95")),
        )
        for group, methods in metrics["groups"].items()
        if (found := methods.get(run)) is not None
    ]
    header = (
        "group",
        "frames",
        "with a pose",
        *(f"{n}, {unit}" for n in ("median", "mean", "p95")),
    )
    return [
        "Measured by `spn-model evaluate` with PyTorch, without any alignment.",
        _table((*header, "median, deg", "mean, deg", "p95, deg"), rows),
    ]


def _bundle_errors(errors: Sequence[GroupErrors], unit: str) -> str:
    rows = []
    for one in errors:
        percent = int8_error_increase(errors, one.group) if one.precision == INT8 else None
        increase = "" if percent is None else ", ".join(map(percent_text, percent))
        rows.append(
            (
                one.group,
                one.precision,
                str(one.images),
                str(one.located),
                _number(one.position),
                _number(one.rotation_deg),
                increase,
            )
        )
    header = ("group", "graph", "images", "with a pose", f"median, {unit}", "median, deg")
    return _table((*header, "against float32"), rows)


def _licence(checkpoint: Checkpoint, facts: Mapping[str, Any]) -> str:
    recipe = facts.get("recipe")
    weights = recipe.get("weights") if isinstance(recipe, Mapping) else None
    if weights is None:
        return "Not recorded with the run."
    if weights == "none":
        return "None: training started from random weights."
    name = checkpoint.model.weights_name if weights == "published" else str(weights)
    try:
        known = by_name(name)
    except InputError:
        return f"Training started from a user-supplied file, {name}: its licence applies."
    return f"{known.holds} ({known.name}): {known.licence}."


def percent_text(value: float) -> str:
    """Format a change by percent; NaN means that one of both errors has no median."""
    return f"{value:+.1f} %" if math.isfinite(value) else "not known"


def _number(value: float | None) -> str:
    """Format a number; infinity (null in JSON) means that too few frames have a pose."""
    return "none" if value is None or not math.isfinite(value) else f"{value:.3f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines
    )


def _list(*items: str) -> str:
    return "\n".join(f"- {item}" for item in items)
