"""Export of a trained network as a bundle for the drone."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError, SpnError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.inputs.landmark_source import LandmarkSource
from spn_data.storage.files import replace_folder, write_atomically
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import finite, write_json
from spn_data.work.timing import Progress
from spn_model.evaluation.evaluate import check_world
from spn_model.evaluation.validation import spread_rows
from spn_model.export.bundle_checks import (
    BundleOptions,
    compare_with_pytorch,
    measure_errors,
)
from spn_model.export.exported import ExportedBundle
from spn_model.export.gimbal_mounting import measure_mounting
from spn_model.export.graphs import Deployment, deployment, write_graph
from spn_model.export.landmark_export import training_names, write_landmarks
from spn_model.export.model_card import model_card
from spn_model.export.quantization import quantize
from spn_model.models.checkpoint import Checkpoint
from spn_model.onboard.bundle import (
    CARD,
    CONVENTIONS,
    DOCUMENT,
    FLOAT32,
    FORMAT,
    GRAPHS,
    INT8,
    LANDMARKS,
    OFFSET_CONVENTION,
    OFFSET_VERSION,
    VERSION,
    read_bundle,
    sha256_of,
    verified_landmarks,
    verified_path,
)

_logger = logging.getLogger(__name__)


def export(
    checkpoint: Checkpoint,
    dataset: Path,
    folder: Path,
    facts: Mapping[str, Any],
    progress: Progress,
    options: BundleOptions | None = None,
    *,
    world_names: Sequence[str] = (),
    metrics: Mapping[str, Any] | None = None,
    source: LandmarkSource | None = None,
    overwrite: bool = False,
) -> ExportedBundle:
    """Write a bundle of a trained network; the folder is replaced atomically.

    Parameters
    ----------
    checkpoint : Checkpoint
        Trained network.
    dataset : Path
        The data set of the training, or another one of the same world. Its training images calibrate the
        8-bit graph, its evaluation sequences measure the errors.
    folder : Path
        Target folder.
    facts : mapping
        Plain values of the run, for the model card.
    progress : Progress
        Receives the step, items done, and items in total.
    options : BundleOptions, optional
        Content and checks of the bundle.
    world_names : sequence of str
        Names of the fingerprints that identify the world of a data set.
    metrics : mapping, optional
        Evaluation of the run, as in metrics.json; None if there is none.
    source : LandmarkSource, optional
        Map that gives the landmarks; None for a bundle without them.
    overwrite : bool
        Whether a bundle in the folder may be replaced.

    Returns
    -------
    ExportedBundle

    Raises
    ------
    StageError
        If the folder may not be replaced, or the disk does not accept the files.
    InputError
        If data set and network do not belong together.
    GeometryError
        If the graph gives other poses than PyTorch.
    """
    options = options or BundleOptions()
    _check_replaceable(folder, overwrite)
    partial = folder.with_name(f".{folder.name}.partial")
    with Dataset(dataset) as data:
        check_world(
            checkpoint,
            data,
            str(facts.get("run", "the network")),
            world_names,
            content_fingerprint(dataset),
        )
        deployed = deployment(checkpoint.model, checkpoint.view.size)
        camera = _input_camera(checkpoint, data).scaled(*deployed.size)
        view = replace(checkpoint.view, camera=_input_camera(checkpoint, data))
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            _write_graphs(partial, deployed, data, options, progress)
            graphs = _graph_entries(partial)
            document: dict[str, Any] = {
                "format": FORMAT,
                "version": OFFSET_VERSION if any(view.offset) else VERSION,
                "conventions": CONVENTIONS + (OFFSET_CONVENTION if any(view.offset) else ""),
                "kind": checkpoint.model.kind,
                "view": view.to_json(),
                "input": camera_to_json(camera),
                "decoding": deployed.decoding.to_json(),
                "graphs": graphs,
                "run": dict(facts),
            }
            landmarks, mounted = None, ""
            if source is not None and options.map_mb:
                landmarks = write_landmarks(
                    partial / LANDMARKS,
                    source,
                    data,
                    graphs[FLOAT32]["sha256"],
                    np.array(view.offset),
                    max_bytes=round(1e6 * options.map_mb),
                )
                document["landmarks"] = {**_entry(partial / LANDMARKS), **asdict(landmarks)}
                gimbal, mounted = measure_mounting(source, training_names(data))
                document["gimbal"] = None if gimbal is None else gimbal.to_json()
            write_json(partial / DOCUMENT, document)
            parity = compare_with_pytorch(partial, checkpoint, deployed, data, options, progress)
            errors = measure_errors(partial, deployed, data, options, progress)
            made = ExportedBundle(
                folder=folder,
                units=view.units,
                bytes={name: entry["bytes"] for name, entry in graphs.items()},
                parity=parity,
                errors=errors,
                landmarks=landmarks,
                gimbal=mounted,
            )
            document["measured"] = {
                "parity": asdict(parity),
                "errors": [finite(asdict(one)) for one in errors],
                "options": asdict(options),
            }
            write_json(partial / DOCUMENT, document)
            write_atomically(partial / CARD, model_card(checkpoint, made, facts, metrics, document))
            read_bundle(partial)
            replace_folder(partial, folder)
        except OSError as error:
            raise StageError(f"{folder} cannot be written: {error.strerror}") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return made


def is_up_to_date(folder: Path, facts: Mapping[str, Any], options: BundleOptions) -> bool:
    """Return whether a folder holds a complete bundle that another export would reproduce.

    Parameters
    ----------
    folder : Path
        Folder of the bundle.
    facts : mapping
        Facts of the run that the bundle has to state.
    options : BundleOptions
        Options that the bundle has to be made with.

    Returns
    -------
    bool
    """
    try:
        bundle = read_bundle(folder)
        document = bundle.document
        measured, run = document["measured"], document["run"]
        same = all(run[name] == value for name, value in facts.items())
        for graph in bundle.graphs.values():
            verified_path(graph)
        if bundle.landmarks is not None:
            verified_landmarks(bundle)
        return bool(same and measured["options"] == asdict(options))
    except (SpnError, KeyError, TypeError) as error:
        _logger.debug("%s: not an up-to-date bundle: %r", folder, error)
        return False


def _check_replaceable(folder: Path, overwrite: bool) -> None:
    """Raise StageError if the folder holds something that may not be replaced; only bundles ever are."""
    if not folder.exists():
        return
    if not overwrite:
        raise StageError(f"{folder} already exists; use --overwrite to replace it")
    ours = {DOCUMENT, CARD, LANDMARKS, *GRAPHS.values()}
    foreign = (
        [] if not folder.is_dir() else [p.name for p in folder.iterdir() if p.name not in ours]
    )
    if foreign or not (folder / DOCUMENT).is_file():
        raise StageError(
            f"{folder} holds something other than a bundle and was left unchanged; choose another folder"
        )


def _input_camera(checkpoint: Checkpoint, data: Dataset) -> Camera:
    """Return the network's camera, or the median pinhole of its training images if each had its own."""
    view = checkpoint.view
    if view.camera is not None:
        return view.camera
    if not checkpoint.model.any_camera:
        raise InputError(
            "the network was trained on images of several cameras, but its kind supports only one, so there "
            "is no camera to render into on board; train it on a data set with a common camera",
            path=data.path,
        )
    matrices = _training_group(data).intrinsics
    known = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not len(known):
        raise InputError(
            "the cameras of its training images are unknown, so there is no camera to render into on board",
            path=data.path,
        )
    middle = np.median(known, axis=0)
    params = np.array([middle[0, 0], middle[1, 1], middle[0, 2], middle[1, 2]])
    return Camera("PINHOLE", *view.size, params)


def _training_group(data: Dataset) -> DatasetGroup:
    for group in data.of_role(Role.TRAIN):
        if len(group):
            return group
    raise InputError("has no training images to calibrate the 8-bit graph with", path=data.path)


def _write_graphs(
    folder: Path, deployed: Deployment, data: Dataset, options: BundleOptions, progress: Progress
) -> None:
    progress("float32", 0, 1)
    write_graph(folder / GRAPHS[FLOAT32], deployed)
    progress("float32", 1, 1)
    if options.int8:
        training = _training_group(data)
        rows = spread_rows(len(training), options.calibration_images)

        def images() -> Any:
            for done, row in enumerate(rows):
                progress("int8", done, len(rows))
                yield deployed.graph_input(training.image(int(row)))

        quantize(folder / GRAPHS[FLOAT32], folder / GRAPHS[INT8], images())
        progress("int8", len(rows), len(rows))


def _graph_entries(folder: Path) -> dict[str, dict[str, Any]]:
    paths = {p: folder / name for p, name in GRAPHS.items() if (folder / name).is_file()}
    return {precision: _entry(path) for precision, path in paths.items()}


def _entry(path: Path) -> dict[str, Any]:
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": sha256_of(path)}
