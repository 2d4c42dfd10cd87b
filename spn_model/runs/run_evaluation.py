"""Evaluation of trained networks of an area, with results in the folders of their runs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spn_data.area.names import COMPARED, GEO, MODEL, RETRIEVAL
from spn_data.errors import FormatError, InputError
from spn_data.storage.files import write_atomically
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import load_json
from spn_data.work.timing import Progress
from spn_model.evaluation.comparison_files import network_facts, select_network, write_comparison
from spn_model.evaluation.evaluate import EvaluateOptions, NetworkComparison, compare
from spn_model.evaluation.fix_figures import stanford_diagrams
from spn_model.evaluation.fix_files import RunFixes, write_fixes
from spn_model.export.model_card import card_with_metrics
from spn_model.models.checkpoint import load
from spn_model.onboard.bundle import CARD
from spn_model.runs.run_files import RunFiles
from spn_model.runs.run_fixes import own_bundle
from spn_model.training import machine
from spn_model.training.training_figure import read_log, training_figure


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluatedRuns:
    """Comparison of runs of one area.

    Attributes
    ----------
    runs : tuple of RunFiles
        Files of the runs.
    comparison : NetworkComparison
        Errors of their networks and of the baselines.
    facts : mapping of str to mapping
        Facts of each network by name of its run, for `facts` of metrics.json.
    fixes : mapping of str to RunFixes
        Fixes of the bundle of each run, by its name.
    """

    runs: tuple[RunFiles, ...]
    comparison: NetworkComparison
    facts: Mapping[str, Mapping[str, Any]]
    fixes: Mapping[str, RunFixes]


@dataclass(frozen=True, kw_only=True)
class WrittenEvaluation:
    """Result files of an evaluation.

    Attributes
    ----------
    folders : tuple of Path
        Folders with metrics.json, errors.csv and figures.
    notes : tuple of str
        One sentence each.
    """

    folders: tuple[Path, ...]
    notes: tuple[str, ...]


def evaluate_runs(
    runs: Sequence[RunFiles],
    dataset: Path,
    progress: Progress,
    options: EvaluateOptions,
    *,
    fixes: Mapping[str, RunFixes],
    device: str = "auto",
    threads: int = 0,
) -> EvaluatedRuns:
    """Evaluate the networks of runs of one area on a data set.

    Parameters
    ----------
    runs : sequence of RunFiles
        Files of the runs.
    dataset : Path
        Data set of the world that they were trained in.
    progress : Progress
        Receives the network's name, frames done, and frames in total.
    options : EvaluateOptions
        What is evaluated.
    fixes : mapping of str to RunFixes
        Fixes of the bundle of each run, by its name.
    device : str
        Device of the networks, see `machine.choose`.
    threads : int
        CPU threads; 0 for all cores.

    Returns
    -------
    EvaluatedRuns

    Raises
    ------
    StageError
        If a run has no checkpoint.
    InputError
        If the device does not exist, or data set and networks do not belong together.
    FormatError
        If a file is damaged or of another version.
    """
    checkpoints = {run.name: run.require_checkpoint() for run in runs}
    chosen = machine.choose(device, threads, "float32")
    with machine.limited_threads(chosen):
        networks = {name: load(path, chosen.device) for name, path in checkpoints.items()}
        comparison = compare(
            dataset,
            networks,
            (MODEL, GEO),
            progress,
            options,
            kept=runs[0].folder.parent / RETRIEVAL,
        )
    facts = {
        name: {**network_facts(network), "checkpoint": content_fingerprint(checkpoints[name])}
        for name, network in networks.items()
    }
    return EvaluatedRuns(runs=tuple(runs), comparison=comparison, facts=facts, fixes=fixes)


def write_evaluation(
    evaluated: EvaluatedRuns, error_limits: tuple[float, float] | None = None
) -> WrittenEvaluation:
    """Write results and figures into the folder of each run, and those of several runs into one more.

    Parameters
    ----------
    evaluated : EvaluatedRuns
        Result of `evaluate_runs`.
    error_limits : tuple of float, optional
        Ends of the scales of position and rotation errors in histograms; by default, those of each group.

    Returns
    -------
    WrittenEvaluation

    Raises
    ------
    StageError
        If a file cannot be written.
    """
    comparison, notes = evaluated.comparison, []
    unit = "m" if comparison.units == "m" else "model units"
    facts: dict[str, dict[str, Any]] = {}
    figures: dict[str, dict[str, str]] = {}
    for run in evaluated.runs:
        log = None
        try:
            log = read_log(run.log) if run.log.exists() else None
        except InputError as error:
            notes.append(f"the training curves are not drawn: {error}")
        figures[run.name] = {} if log is None else {"training": training_figure(log, unit=unit)}
        facts[run.name] = {
            **evaluated.facts[run.name],
            "course": None if log is None else log.facts(),
        }
    for run in evaluated.runs:
        own, fixes = {run.name: facts[run.name]}, evaluated.fixes[run.name]
        run.metrics.unlink(missing_ok=True)  # never beside the fixes of another evaluation
        run.fixes.unlink(missing_ok=True)
        if fixes.flights:
            write_fixes(run.fixes, fixes.flights)
        drawings = {**figures[run.name], **stanford_diagrams(fixes.flights)}
        document = fixes.to_json()
        _write(run, select_network(comparison, run.name), own, drawings, document, error_limits)
        if run.bundle.exists():
            try:
                _complete_card(run, facts[run.name]["training"].get("trained_on", ()))
            except (InputError, FormatError, OSError) as error:
                notes.append(f"the model card of the bundle was not completed: {error}")
    folders = [run.folder for run in evaluated.runs]
    if len(evaluated.runs) > 1:
        folders.append(folders[0].parent / COMPARED)
        _write(RunFiles(folders[-1]), comparison, facts, {}, None, error_limits)
    return WrittenEvaluation(folders=tuple(folders), notes=tuple(notes))


def _complete_card(run: RunFiles, trained_on: Collection[str]) -> None:
    """Write the errors and fixes of metrics.json into the model card of the bundle."""
    card = own_bundle(run).folder / CARD
    text = card_with_metrics(
        card.read_text(encoding="utf-8"),
        load_json(run.metrics),
        run=run.name,
        trained_on=trained_on,
    )
    write_atomically(card, text)


def _write(
    files: RunFiles,
    comparison: NetworkComparison,
    runs: Mapping[str, Any],
    figures: Mapping[str, str],
    fixes: Mapping[str, Any] | None,
    error_limits: tuple[float, float] | None,
) -> None:
    files.folder.mkdir(parents=True, exist_ok=True)
    write_comparison(
        comparison,
        {"runs": runs},
        metrics=files.metrics,
        errors=files.errors,
        drawings=files.figures,
        more_drawings=figures,
        fixes=fixes,
        error_limits=error_limits,
    )
