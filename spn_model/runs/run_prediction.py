"""Prediction with the network of a run: everything is checked first, then the frames are processed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json, read_camera
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.work.timing import Progress
from spn_model.models.checkpoint import Checkpoint, load
from spn_model.prediction.flights import Flight, find_flights
from spn_model.prediction.predict import Predicted, PredictOptions, check_target, predict
from spn_model.runs.run_files import RunFiles
from spn_model.training import machine
from spn_model.training.machine import Machine


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
    """

    run: RunFiles
    network: Checkpoint
    flights: Sequence[Flight]
    camera: Camera | None
    folder: Path
    notes: tuple[str, ...]
    machine: Machine
    overwrite: bool

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
                options,
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
    return Prediction(
        run=run,
        network=network,
        flights=flights,
        camera=camera,
        folder=folder,
        notes=tuple(notes),
        machine=chosen,
        overwrite=overwrite,
    )
