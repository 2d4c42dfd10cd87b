"""Prediction with the network of a run: everything is checked first, then the frames are processed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json, read_camera
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.work.timing import Progress
from spn_model.models.checkpoint import Checkpoint, load
from spn_model.onboard.attitude import GIMBAL, Attitude, check_up, read_attitude
from spn_model.prediction.flights import Flight, find_flights
from spn_model.prediction.predict import Predicted, PredictOptions, check_target, predict
from spn_model.runs.run_files import RunFiles
from spn_model.runs.run_fixes import own_bundle
from spn_model.training import machine
from spn_model.training.machine import Machine


@dataclass(frozen=True, kw_only=True)
class AttitudeFile:
    """A file of pitch and roll; parameters are those of `read_attitude`."""

    path: Path
    of: str = GIMBAL
    sigma_deg: float | None = None
    offset_s: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """A prediction that is ready to run.

    Attributes
    ----------
    run : RunFiles
        Files of the run.
    network : Checkpoint
        Its network.
    flights : sequence of Flight
        Flights to process.
    camera : Camera or None
        Given camera of the flights.
    folder : Path
        Target folder.
    notes : tuple of str
        One sentence each, on the sources and the network.
    machine : Machine
        Device and threads.
    overwrite : bool
        Whether predicted poses in the folder may be replaced.
    attitude : Attitude or None
        Pitch and roll of the one flight.
    """

    run: RunFiles
    network: Checkpoint
    flights: Sequence[Flight]
    camera: Camera | None
    folder: Path
    notes: tuple[str, ...]
    machine: Machine
    overwrite: bool
    attitude: Attitude | None = None

    def write(self, progress: Progress, options: PredictOptions) -> Predicted:
        """Predict and write the poses; parameters and exceptions are those of `predict`."""
        facts = {
            "run": self.run.name,
            "checkpoint": content_fingerprint(self.run.checkpoint),
            "kind": self.network.model.kind,
            "camera": None if self.camera is None else camera_to_json(self.camera),
        }
        with machine.limited_threads(self.machine):
            return predict(
                self.network,
                self.flights,
                self.folder,
                progress,
                replace(options, attitude=self.attitude),
                facts=facts,
                overwrite=self.overwrite,
            )


def prepare_prediction(
    run: RunFiles,
    sources: Sequence[Path],
    camera_file: Path | None,
    target: Path,
    *,
    device: str = "auto",
    threads: int = 0,
    overwrite: bool = False,
    attitude: AttitudeFile | None = None,
) -> Prediction:
    """Open the sources and load the network of a run.

    Parameters
    ----------
    run : RunFiles
        Files of the run.
    sources : sequence of Path
        Photos, videos, or folders of them.
    camera_file : Path or None
        Camera of all sources; None to use the focal lengths in the photo metadata.
    target : Path
        Folder to write.
    device : str
        Device of the network, see `machine.choose`.
    threads : int
        CPU threads; 0 for all cores.
    overwrite : bool
        Whether predicted poses in the folder may be replaced.
    attitude : AttitudeFile, optional
        Pitch and roll of the only source.

    Returns
    -------
    Prediction

    Raises
    ------
    StageError
        If the run has no checkpoint, or the folder may not be written.
    InputError
        If a source, its camera or the device cannot be used.
    FormatError
        If the camera file or the checkpoint is damaged.
    """
    checkpoint = run.require_checkpoint()
    folder = Path(os.path.abspath(target))
    check_target(folder, overwrite=overwrite)
    camera = None if camera_file is None else read_camera(camera_file)
    flights, notes = find_flights(sources, camera)
    chosen = machine.choose(device, threads, "float32")
    with machine.limited_threads(chosen):
        network = load(checkpoint, chosen.device)
    if network.view.camera is None and not network.model.any_camera:
        notes.append(
            "the network was trained on images of several cameras without a common view; poses are only as "
            "accurate as the flying camera resembles them."
        )
    known = None
    if attitude is not None:
        if len(flights) > 1:
            raise InputError(
                f"--attitude belongs to one video, and there are {len(flights)} sequences",
                path=attitude.path,
            )
        known, note = _attitude_for(run, network, attitude)
        notes += [note] if note else []
    return Prediction(
        run=run,
        network=network,
        flights=flights,
        camera=camera,
        folder=folder,
        notes=tuple(notes),
        machine=chosen,
        overwrite=overwrite,
        attitude=known,
    )


def _attitude_for(run: RunFiles, network: Checkpoint, given: AttitudeFile) -> tuple[Attitude, str]:
    """Read an attitude; return it, and a note where the mounting of a gimbal is not known."""
    check_up(network.view, run.checkpoint)
    mounting, note = None, ""
    if given.of == GIMBAL:
        try:
            mounting = own_bundle(run).gimbal
            why = "" if mounting else "the bundle of the run does not know it"
        except InputError as error:
            why = str(error)
        note = (
            why
            and f"the mounting of the gimbal is not known, so its angles count as they are: {why}"
        )
    found = read_attitude(
        given.path,
        of=given.of,
        mounting=mounting,
        body_from_camera=np.eye(3),
        sigma_deg=given.sigma_deg,
        offset_s=given.offset_s,
    )
    return found, note
