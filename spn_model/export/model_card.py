"""MODEL_CARD.md of a bundle: what the network is, what it was found to be worth, and its limits."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from spn_data.errors import InputError
from spn_model.models.checkpoint import Checkpoint
from spn_model.onboard.bundle import FLOAT32, GRAPHS, INT8
from spn_model.pretrained.weights import of_name

if TYPE_CHECKING:
    from spn_model.export.bundle_checks import GroupErrors
    from spn_model.export.exported import ExportedBundle


def model_card(
    checkpoint: Checkpoint,
    made: ExportedBundle,
    facts: Mapping[str, Any],
    metrics: Mapping[str, Any] | None,
) -> str:
    """Markdown. metrics : of the run's evaluation, as metrics.json has it; None: says that there is none."""
    view, model = checkpoint.view, checkpoint.model
    unit = "m" if view.units == "m" else "units of the model"
    parameters = sum(p.numel() for p in model.network.parameters())
    place = view.origin
    parts = [
        f"# {facts.get('run', 'Network')}",
        f"Pose of a camera from one image, in one area: a network of kind {model.kind} with "
        f"{parameters:,} parameters.",
        _list(
            f"Input: {view.size[0]} x {view.size[1]} px, horizontal field of view "
            + (
                "of each image"
                if view.camera is None
                else f"{view.camera.horizontal_fov_deg:.1f} deg"
            )
            + "; the program on board renders a flying camera's images into it.",
            f"Output: camera centre in {unit}, orientation, 6 x 6 covariance.",
            "World: "
            + (
                "without a known place."
                if place is None
                else f"East, North, Up about latitude {place.lat_deg:.7f}, longitude {place.lon_deg:.7f}, "
                f"height {place.alt_m:.2f} m ({place.height_reference.value})."
            ),
            f"Data set: {view.dataset} (fingerprint).",
            *(
                f"Graph {GRAPHS[p]}: {size / 1e6:.2f} MB, {p}, SHA-256 in bundle.json."
                for p, size in made.bytes.items()
            ),
        ),
        "## Errors",
        *_evaluated(metrics, str(facts.get("run", "")), unit, facts.get("trained_on", ())),
        "## What the bundle loses",
        f"On {made.parity.images} images, outputs of the float32 graph differ from PyTorch's by at most "
        f"{made.parity.output:.1e} of an output's largest value; half of the poses by at most "
        f"{made.parity.position:.1e} {unit} and {made.parity.rotation_deg:.1e} deg, all by at most "
        f"{made.parity.largest_sigmas:.1e} of their own standard deviations.",
        _loss(made.errors, unit),
        "## Limits",
        _list(
            "Poses are right in the area that the training images show, and nowhere else.",
            "Light, season and moved things that no training image shows were not measured.",
            "A covariance tells how sure the network is of what it knows; it does not notice every view "
            "that it has never seen.",
            "Not certified for any use in which an error endangers people.",
        ),
        "## Licence of the weights that training started from",
        _licence(checkpoint, facts),
    ]
    return "\n\n".join(parts) + "\n"


def loss_percent(errors: Sequence[GroupErrors], group: str) -> tuple[float, float] | None:
    """By how much int8 raises the median errors of a group, position and rotation; None without int8."""
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


def _evaluated(
    metrics: Mapping[str, Any] | None, run: str, unit: str, learnt: Collection[str]
) -> list[str]:
    if metrics is None:
        return [
            "The run was not evaluated: `spn-model evaluate` measures it, and another export tells it."
        ]
    rows = [
        (
            f"{group} (trained on)" if group in learnt else group,
            str(found["frames"]),
            str(found["located"]),
            *(_figure(found["position"][name]) for name in ("median", "mean", "p95")),
            *(_figure(found["rotation_deg"][name]) for name in ("median", "mean", "p95")),
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
        "As `spn-model evaluate` found them with PyTorch; without any alignment.",
        _table((*header, "median, deg", "mean, deg", "p95, deg"), rows),
    ]


def _loss(errors: Sequence[GroupErrors], unit: str) -> str:
    rows = []
    for one in errors:
        percent = loss_percent(errors, one.group) if one.precision == INT8 else None
        told = "" if percent is None else f"{percent[0]:+.1f} %, {percent[1]:+.1f} %"
        rows.append(
            (
                one.group,
                one.precision,
                str(one.images),
                str(one.located),
                _figure(one.position),
                _figure(one.rotation_deg),
                told,
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
        known = of_name(name)
    except InputError:
        return f"Training started from a file of the user, {name}: its licence holds."
    return f"{known.holds} ({known.name}): {known.licence}."


def _figure(value: float | None) -> str:
    """Infinite, which JSON has as null: too few frames have a pose."""
    return "none" if value is None or not math.isfinite(value) else f"{value:.3f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines
    )


def _list(*items: str) -> str:
    return "\n".join(f"- {item}" for item in items)
