"""Export of the network of a run, with the metrics of its evaluation in the model card."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spn_data.area.names import GEO, MODEL
from spn_data.errors import FormatError
from spn_data.inputs.landmark_source import LandmarkSource
from spn_data.storage.files import write_atomically
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import DAMAGE, load_json
from spn_data.work.timing import Progress
from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import export, is_up_to_date
from spn_model.export.exported import ExportedBundle
from spn_model.export.model_card import card_with_verdict, fix_section
from spn_model.models.checkpoint import load
from spn_model.onboard.bundle import CARD
from spn_model.runs.run_files import RunFiles


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportedRun:
    """Result of exporting a run.

    Attributes
    ----------
    folder : Path
        Folder of the bundle.
    bundle : ExportedBundle or None
        What was written; None if the bundle was up to date.
    is_evaluated : bool
        Whether the model card contains metrics of this network.
    notes : tuple of str
        One sentence each.
    """

    folder: Path
    bundle: ExportedBundle | None
    is_evaluated: bool
    notes: tuple[str, ...] = ()


def export_run(
    run: RunFiles,
    dataset: Path,
    progress: Progress,
    options: BundleOptions,
    *,
    source: LandmarkSource | None = None,
    target: Path | None = None,
    overwrite: bool = False,
) -> ExportedRun:
    """Export the network of a run as a bundle, unless an existing bundle is up to date.

    Parameters
    ----------
    run : RunFiles
        Files of the run.
    dataset : Path
        Data set of the training, or another one of the same world.
    progress : Progress
        Receives the step, items done, and items in total.
    options : BundleOptions
        Content and checks of the bundle.
    source : LandmarkSource, optional
        Map that gives the landmarks of the bundle.
    target : Path, optional
        Folder of the bundle; by default in the folder of the run.
    overwrite : bool
        Whether to replace a bundle in the folder, even if it is up to date.

    Returns
    -------
    ExportedRun

    Raises
    ------
    StageError
        If the run has no checkpoint, the folder may not be replaced, or the disk does not accept the files.
    InputError
        If data set and network do not belong together.
    FormatError
        If the checkpoint is damaged or of another version.
    GeometryError
        If the graph gives other poses than PyTorch.
    """
    checkpoint, folder = run.require_checkpoint(), target or run.bundle
    fingerprint = content_fingerprint(checkpoint)
    metrics, notes = _read_metrics(run, fingerprint)
    facts = {"run": run.name, "checkpoint": fingerprint}
    bundle = None
    if overwrite or not is_up_to_date(folder, facts, options):
        network = load(checkpoint)
        bundle = export(
            network,
            dataset,
            folder,
            {**network.facts, **facts},
            progress,
            options,
            world_names=(MODEL, GEO),
            metrics=metrics,
            source=source,
            overwrite=overwrite,
        )
    return ExportedRun(
        folder=folder, bundle=bundle, is_evaluated=metrics is not None, notes=tuple(notes)
    )


def write_verdict(folder: Path, parts: Iterable[tuple[str, str]]) -> None:
    """Write the verdict on the area into the model card of a bundle.

    Parameters
    ----------
    folder : Path
        Folder of the bundle.
    parts : iterable of (str, str)
        Name of each part, and what is said.

    Raises
    ------
    FormatError
        If the card cannot be read.
    StageError
        If it cannot be written.
    """
    card = folder / CARD
    try:
        text = card.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{card}: cannot be read ({error!r:.200})") from error
    changed = card_with_verdict(text, parts)
    if changed != text:
        write_atomically(card, changed)


def _read_metrics(run: RunFiles, fingerprint: str) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the metrics of the checkpoint with this fingerprint, if there are any, and notes."""
    if not run.metrics.is_file():
        return None, []
    try:
        metrics = load_json(run.metrics)
        is_same = metrics["facts"]["runs"][run.name]["checkpoint"] == fingerprint
        fix_section(metrics.get("fixes"))  # raises if they are damaged
        has_run = any(run.name in methods for methods in metrics["groups"].values())
        return (metrics if is_same and has_run else None), []
    except (*DAMAGE, FormatError) as error:
        return None, [
            f"{run.metrics} cannot be read ({error!r}): the model card contains no errors."
        ]
