"""Files of an evaluation: metrics.json, errors.csv and figures, which are replaced together."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from spn_data.capture.sources import safe_name
from spn_data.dataset.hdf5_schema import Role
from spn_data.storage.files import write_atomically
from spn_model.evaluation import figures
from spn_model.evaluation.baselines import MEAN
from spn_model.evaluation.evaluate import EvaluatedGroup, NetworkComparison, NetworkCost
from spn_model.evaluation.tables import write_errors, write_metrics
from spn_model.models.checkpoint import Checkpoint


def select_network(comparison: NetworkComparison, name: str) -> NetworkComparison:
    """Return a comparison that keeps one network (and its dropout estimates) and all baselines.

    Parameters
    ----------
    comparison : NetworkComparison
        Comparison of several networks.
    name : str
        Network to keep.

    Returns
    -------
    NetworkComparison
    """
    others = {n for n in comparison.networks if n != name and not n.startswith(f"{name}, ")}
    return replace(
        comparison,
        groups=tuple(
            replace(
                group,
                estimates=tuple(e for e in group.estimates if e.method not in others),
                evaluations=tuple(e for e in group.evaluations if e.method not in others),
            )
            for group in comparison.groups
        ),
        networks=tuple(n for n in comparison.networks if n not in others),
        costs={n: cost for n, cost in comparison.costs.items() if n not in others},
    )


def write_comparison(
    comparison: NetworkComparison,
    facts: Mapping[str, Any],
    *,
    metrics: Path,
    errors: Path,
    drawings: Path,
    more_drawings: Mapping[str, str] | None = None,
    fixes: Mapping[str, Any] | None = None,
    error_limits: tuple[float, float] | None = None,
) -> None:
    """Write metrics.json, errors.csv and a folder of SVG figures.

    Old figures are removed first and metrics.json is written last, so that figures never belong to other
    numbers.

    Parameters
    ----------
    comparison : NetworkComparison
        What is written.
    facts : mapping
        Additional plain values for the `facts` of metrics.json.
    metrics, errors, drawings : Path
        Files metrics.json and errors.csv, and folder of figures.
    more_drawings : mapping, optional
        Further SVG figures by name, without suffix.
    fixes : mapping, optional
        Fixes of the run, as plain values.
    error_limits : tuple of float, optional
        Ends of the scales of position and rotation errors in histograms; by default, those of each group.

    Raises
    ------
    StageError
        If the disk does not accept the files.
    """
    metrics.unlink(missing_ok=True)
    shutil.rmtree(drawings, ignore_errors=True)
    drawings.mkdir(parents=True)
    names = file_names([group.frames.group for group in comparison.groups])
    for name, group in zip(names, comparison.groups, strict=True):
        for what, drawing in draw_figures(group, comparison, error_limits).items():
            write_atomically(drawings / f"{name}-{what}.svg", drawing)
    for what, drawing in (more_drawings or {}).items():
        write_atomically(drawings / f"{what}.svg", drawing)
    evaluations = [one for group in comparison.groups for one in group.evaluations]
    write_errors(errors, evaluations)
    write_metrics(
        metrics,
        evaluations,
        units=comparison.units,
        retrieval={g.frames.group: g.retrieval for g in comparison.groups if g.retrieval},
        facts={
            "roles": {group.frames.group: group.role.value for group in comparison.groups},
            "networks": list(comparison.networks),
            "costs": {name: cost_facts(cost) for name, cost in comparison.costs.items()},
            "dataset": comparison.fingerprint,
            "notes": list(comparison.notes),
            **facts,
        },
        fixes=fixes,
    )


def network_facts(network: Checkpoint) -> dict[str, Any]:
    """Return what a network is and how it was trained, for `facts` of `write_comparison`."""
    state = network.model.network.state_dict().values()
    return {
        "kind": network.model.kind,
        "options": network.model.options,
        "parameters": sum(p.numel() for p in network.model.network.parameters()),
        "bytes": sum(t.numel() * t.element_size() for t in state),
        "trained_on": network.view.dataset,
        "training": network.facts,
    }


def cost_facts(cost: NetworkCost) -> dict[str, Any]:
    """Return the cost as written to metrics.json."""
    return {**asdict(cost), "ms_an_image": round(1000 * cost.seconds / cost.images, 3)}


def draw_figures(
    group: EvaluatedGroup,
    comparison: NetworkComparison,
    error_limits: tuple[float, float] | None = None,
) -> dict[str, str]:
    """Draw the figures of a group, by name.

    Training groups have none, because the nearest training frame of each of their frames is itself.
    """
    if group.role is Role.TRAIN:
        return {}
    unit = "m" if comparison.units == "m" else "model units"
    baseline = [group.retrieval] if group.retrieval else []
    shown = [*comparison.networks, *baseline]
    compared = [e for e in group.evaluations if e.method != MEAN]
    found = {
        "trajectories": figures.trajectories(
            comparison.training, group.frames, _select_methods(group.estimates, shown), unit=unit
        ),
        "histograms": figures.histograms(
            _select_methods(group.evaluations, shown), unit=unit, limits=error_limits
        ),
        "distance": figures.error_curves(compared, unit=unit),
    }
    if any(e.calibration is not None and e.calibration.frames for e in group.evaluations):
        found["calibration"] = figures.calibration(group.evaluations)
    return found


def _select_methods(found: Sequence[Any], methods: Sequence[str]) -> list[Any]:
    """Select methods, in the given order."""
    by_method = {one.method: one for one in found}
    return [by_method[method] for method in methods]


def file_names(groups: Sequence[str]) -> list[str]:
    """Return unique file names of groups that every file system accepts."""
    names: list[str] = []
    for group in groups:
        base = name = safe_name(group, "group").lower()
        number = 2
        while name in names:
            name, number = f"{base}-{number}", number + 1
        names.append(name)
    return names
