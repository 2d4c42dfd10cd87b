"""Fixes of the bundle of a run on the evaluation flights of its area."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from spn_data.errors import InputError, StageError
from spn_data.inputs.evaluation_flights import EvaluationFlights
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.work.timing import Progress
from spn_model.evaluation.fix_files import RunFixes
from spn_model.evaluation.fixes import FlightFixes, measure_flight, steps_of
from spn_model.landmarks.landmark_map import LandmarkMap
from spn_model.onboard.bundle import DOCUMENT, FLOAT32, Bundle, read_bundle, verified_landmarks
from spn_model.runs.run_files import RunFiles


def own_bundle(run: RunFiles) -> Bundle:
    """Return the bundle of a run; raise InputError if there is none, or one of an earlier network."""
    if not (run.bundle / DOCUMENT).is_file():
        raise InputError(
            f"there is no bundle; run spn-model export --run {run.name} first", path=run.bundle
        )
    bundle = read_bundle(run.bundle)
    facts = bundle.document.get("run")
    made_of = facts.get("checkpoint") if isinstance(facts, dict) else None
    if made_of != content_fingerprint(run.require_checkpoint()):
        raise InputError(
            "the bundle is of an earlier network of this run; run spn-model export "
            f"--run {run.name} --overwrite",
            path=run.bundle,
        )
    return bundle


def flown_bundle(run: RunFiles, map_hash: str) -> Bundle:
    """Return the bundle of a run, if it is of this network and this map.

    Parameters
    ----------
    run : RunFiles
    map_hash : str
        Hash of the map of the area.

    Returns
    -------
    Bundle

    Raises
    ------
    InputError
        If there is no bundle, it has no landmarks, or it is of an earlier network or map.
    FormatError
        If it is damaged.
    """
    bundle = own_bundle(run)
    landmarks = LandmarkMap.load(verified_landmarks(bundle))
    if landmarks.facts.map_hash != map_hash:
        raise InputError(
            "the landmarks of the bundle are of another map than that of the area; run spn-model export "
            f"--run {run.name} --overwrite",
            path=run.bundle,
        )
    return bundle


def fixes_of_runs(
    runs: Sequence[RunFiles],
    read_flights: Callable[[], EvaluationFlights],
    progress: Progress,
    *,
    required: bool,
    attitude: bool = True,
) -> dict[str, RunFixes]:
    """Measure the fixes of the bundles of several runs.

    Parameters
    ----------
    runs : sequence of RunFiles
    read_flights : callable
        Returns the evaluation flights; not called unless there is a bundle.
    progress : Progress
        Receives the run and the flight, images done, and images in total.
    required : bool
        Whether to raise the error if fixes of a run cannot be measured, instead of returning it as reason.
    attitude : bool
        Whether to measure them a second time, with a known attitude.

    Returns
    -------
    dict of str to RunFixes

    Raises
    ------
    InputError, StageError
        If they are required and cannot be measured.
    FormatError
        If a bundle is damaged.
    """
    found = {}
    flights = None
    for run in runs:
        try:
            own_bundle(run)
            flights = flights or read_flights()
            found[run.name] = measure_fixes(run, flights, progress, attitude=attitude)
        except (InputError, StageError) as error:
            if required:
                raise
            found[run.name] = RunFixes(reason=str(error))
    return found


def measure_fixes(
    run: RunFiles, found: EvaluationFlights, progress: Progress, *, attitude: bool
) -> RunFixes:
    """Localize the images of all evaluation flights with the bundle of a run.

    Parameters
    ----------
    run : RunFiles
    found : EvaluationFlights
    progress : Progress
        Receives the run and the flight, images done, and images in total.
    attitude : bool
        Whether to localize them a second time, with a known attitude.

    Returns
    -------
    RunFixes

    Raises
    ------
    InputError, FormatError
        If the bundle is missing, of another network or map, or damaged, or an image cannot be read.
    """
    bundle = flown_bundle(run, found.map_hash)
    measured: list[FlightFixes] = []
    notes: list[str] = []
    for flight in found.flights:
        total, done = steps_of(flight, attitude=attitude), 0

        def count(name: str = f"{run.name}, fixes of {flight.name}", total: int = total) -> None:
            nonlocal done
            done += 1
            progress(name, done, total)

        fixes, note = measure_flight(bundle.folder, flight, count, attitude=attitude)
        measured += fixes
        notes += [note] if note else []
    assert bundle.landmarks is not None  # flown_bundle
    return RunFixes(
        flights=tuple(measured),
        bundle={
            "network": bundle.graphs[FLOAT32].sha256,
            "landmarks": bundle.landmarks.sha256,
            "map": found.map_hash,
        },
        notes=tuple(notes),
    )
