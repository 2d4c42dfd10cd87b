"""A trained network as a bundle for the drone: graphs, what makes poses of them, what they are worth."""

from __future__ import annotations

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
from spn_model.export.graphs import Deployment, deployment, write_graph
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
    VERSION,
    read_bundle,
    sha256_of,
    verified,
)


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
    overwrite: bool = False,
) -> ExportedBundle:
    """Write a bundle of a trained network; the folder appears whole, or not at all.

    dataset : that it was trained on, or another of its world: 8 bits are calibrated on its training images
    and errors measured on its evaluation sequences. facts : of the run, plain values, for the card; metrics :
    of the run's evaluation, as metrics.json has it, None where there is none.
    Raises StageError where the folder exists and may not be replaced, or the disk does not take it;
    InputError where data set and network do not belong together; GeometryError where the graph gives
    other poses than PyTorch.
    """
    options = options or BundleOptions()
    _check_free(folder, overwrite)
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
        camera = _camera(checkpoint, data).scaled(*deployed.size)
        view = replace(checkpoint.view, camera=_camera(checkpoint, data))
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            _write_graphs(partial, deployed, data, options, progress)
            document = {
                "format": FORMAT,
                "version": VERSION,
                "conventions": CONVENTIONS,
                "kind": checkpoint.model.kind,
                "view": view.to_json(),
                "input": camera_to_json(camera),
                "decoding": deployed.decoding.to_json(),
                "graphs": _graphs(partial),
                "run": dict(facts),
            }
            write_json(partial / DOCUMENT, document)
            parity = compare_with_pytorch(partial, checkpoint, deployed, data, options, progress)
            errors = measure_errors(partial, deployed, data, options, progress)
            made = ExportedBundle(
                folder=folder,
                units=view.units,
                bytes={name: entry["bytes"] for name, entry in _graphs(partial).items()},
                parity=parity,
                errors=errors,
            )
            document["measured"] = {
                "parity": asdict(parity),
                "errors": [finite(asdict(one)) for one in errors],
                "options": asdict(options),
            }
            write_json(partial / DOCUMENT, document)
            write_atomically(partial / CARD, model_card(checkpoint, made, facts, metrics))
            read_bundle(partial)
            replace_folder(partial, folder)
        except OSError as error:
            raise StageError(f"{folder} cannot be written: {error.strerror}") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return made


def is_made_of(folder: Path, facts: Mapping[str, Any], options: BundleOptions) -> bool:
    """Whether a whole bundle stands there that another export would make again."""
    try:
        bundle = read_bundle(folder)
        document = bundle.document
        measured, run = document["measured"], document["run"]
        same = all(run[name] == value for name, value in facts.items())
        for graph in bundle.graphs.values():
            verified(graph)
        return bool(same and measured["options"] == asdict(options))
    except (SpnError, KeyError, TypeError):
        return False


def _check_free(folder: Path, overwrite: bool) -> None:
    """Raises StageError where something stands that may not be replaced: only a bundle ever is."""
    if not folder.exists():
        return
    if not overwrite:
        raise StageError(f"{folder} stands already; --overwrite makes it anew")
    ours = {DOCUMENT, CARD, *GRAPHS.values()}
    foreign = (
        [] if not folder.is_dir() else [p.name for p in folder.iterdir() if p.name not in ours]
    )
    if foreign or not (folder / DOCUMENT).is_file():
        raise StageError(
            f"{folder} holds something else than a bundle, and is left as it is; name another folder"
        )


def _camera(checkpoint: Checkpoint, data: Dataset) -> Camera:
    """The network's own; for one that takes any camera and was trained on several, their median pinhole."""
    view = checkpoint.view
    if view.camera is not None:
        return view.camera
    if not checkpoint.model.any_camera:
        raise InputError(
            "the network was trained on images of several cameras, and its kind knows one: on board there "
            "would be none to render into. Train it on a data set with a common camera",
            path=data.path,
        )
    matrices = _training(data).intrinsics
    known = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not len(known):
        raise InputError(
            "the cameras of its training images are not known: on board there would be none to render into",
            path=data.path,
        )
    middle = np.median(known, axis=0)
    params = np.array([middle[0, 0], middle[1, 1], middle[0, 2], middle[1, 2]])
    return Camera("PINHOLE", *view.size, params)


def _training(data: Dataset) -> DatasetGroup:
    for group in data.of_role(Role.TRAIN):
        if len(group):
            return group
    raise InputError("holds no training images to calibrate 8 bits on", path=data.path)


def _write_graphs(
    folder: Path, deployed: Deployment, data: Dataset, options: BundleOptions, progress: Progress
) -> None:
    progress("float32", 0, 1)
    write_graph(folder / GRAPHS[FLOAT32], deployed)
    progress("float32", 1, 1)
    if options.int8:
        training = _training(data)
        rows = spread_rows(len(training), options.calibration_images)

        def images() -> Any:
            for done, row in enumerate(rows):
                progress("int8", done, len(rows))
                yield deployed.sized(training.image(int(row)))

        quantize(folder / GRAPHS[FLOAT32], folder / GRAPHS[INT8], images())
        progress("int8", len(rows), len(rows))


def _graphs(folder: Path) -> dict[str, dict[str, Any]]:
    paths = {p: folder / name for p, name in GRAPHS.items() if (folder / name).is_file()}
    return {
        precision: {"file": path.name, "bytes": path.stat().st_size, "sha256": sha256_of(path)}
        for precision, path in paths.items()
    }
