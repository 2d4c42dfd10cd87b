"""Prediction of poses with a trained network, streamed to files; frames without a pose are marked as such."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import StageError
from spn_data.geometry.pose import position_text
from spn_data.storage.files import replace_folder, write_atomically
from spn_data.storage.json_files import write_json
from spn_data.work.timing import Progress
from spn_model.landmarks.aids import KnownVertical
from spn_model.models.checkpoint import Checkpoint
from spn_model.onboard.attitude import Attitude
from spn_model.prediction.flights import Flight, FlightFrame, FrameFilter, ViewRenderers, frames
from spn_model.prediction.predicted_files import PoseRows, PoseTable, tum_texts, write_wgs84

VERSION = 1
RECORD, POSES, WGS84, TUM = "predict.json", "poses.csv", "wgs84.csv", "tum"
FORMATS = ("csv", "tum", "wgs84")


@dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Which frames are predicted, and what is written.

    Attributes
    ----------
    choice : FrameFilter
        Frames of videos to use.
    formats : tuple of str
        Of `FORMATS`; the CSV is always written.
    batch : int
        Batch size.
    attitude : Attitude or None
        Pitch and roll over the times of the one flight.
    """

    choice: FrameFilter = field(default_factory=FrameFilter)
    formats: tuple[str, ...] = ("csv",)
    batch: int = 8
    attitude: Attitude | None = None


@dataclass(frozen=True, kw_only=True)
class Predicted:
    """What was written. counts : frames by status; reasons : of failures, most frequent first.

    complete : whether all frames were processed; seen : smallest share of the network's view that a camera
    covered; seconds : time of the network alone; with_attitude : frames whose attitude was known.
    """

    folder: Path
    counts: Mapping[str, int]
    reasons: Sequence[tuple[str, int]]
    complete: bool
    seen: float
    seconds: float
    with_attitude: int = 0


def check_target(folder: Path, *, overwrite: bool) -> None:
    """Check that poses may be written to a folder.

    Parameters
    ----------
    folder : Path
        Target of `predict`.
    overwrite : bool
        Whether predicted poses may be replaced.

    Raises
    ------
    StageError
        If the folder holds anything but predicted poses, or holds poses and `overwrite` is false.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise StageError(f"{folder} is not a folder; choose another with --to")
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not (folder / RECORD).is_file():
        raise StageError(
            f"{folder} holds files other than predicted poses; choose another folder with --to"
        )
    if not overwrite:
        raise StageError(f"{folder} already holds predicted poses; use --overwrite to replace them")


def predict(
    network: Checkpoint,
    flights: Sequence[Flight],
    folder: Path,
    progress: Progress,
    options: PredictOptions | None = None,
    *,
    facts: Mapping[str, Any],
    overwrite: bool = False,
) -> Predicted:
    """Write the poses of all chosen frames to a folder, which is replaced atomically.

    Parameters
    ----------
    network : Checkpoint
        Trained network.
    flights : sequence of Flight
        Flights from `find_flights`.
    folder : Path
        Target folder.
    progress : Progress
        Receives the sequence, frames done, and expected frames.
    options : PredictOptions, optional
        Frames and formats.
    facts : mapping
        Additional plain values for predict.json.
    overwrite : bool
        Whether predicted poses in the folder may be replaced.

    Returns
    -------
    Predicted

    Raises
    ------
    StageError
        If the folder holds something else, if the disk is full, and for WGS84 without a georegistered
        map.
    PredictionStopped
        After Ctrl-C: the folder holds the frames done so far and is marked as incomplete.
    """
    options = options or PredictOptions()
    check_target(folder, overwrite=overwrite)
    origin = network.view.origin
    if "wgs84" in options.formats and origin is None:
        raise StageError(
            "wgs84 needs a georegistered map, but the network was trained in a map without an origin; "
            "write csv or tum, or georegister the area and train again"
        )
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    views = ViewRenderers(network.view)
    seconds, known = 0.0, 0
    try:
        with PoseTable(partial / POSES) as table:
            complete, stop = False, None
            try:
                batches = _estimate_batches(network, flights, views, progress, options)
                for rows, took, with_attitude in batches:
                    table.add(rows)
                    seconds += took
                    known += with_attitude
                complete = True
            except KeyboardInterrupt as error:
                stop = error
            done = table.rows()
        if "tum" in options.formats:
            world = _describe_world(network)
            (partial / TUM).mkdir()
            for name, text in tum_texts(done, world):
                write_atomically(partial / TUM / f"{name}.txt", text)
        if "wgs84" in options.formats and origin is not None:
            write_wgs84(partial / WGS84, done, origin)
        found = Predicted(
            folder=folder,
            counts=done.counts(),
            reasons=done.reasons(),
            complete=complete,
            seen=views.seen,
            seconds=seconds,
            with_attitude=known,
        )
        view = network.view.to_json()
        write_json(
            partial / RECORD,
            {
                "version": VERSION,
                "complete": complete,
                "frames": dict(found.counts),
                "view_seen": round(found.seen, 4),
                "formats": list(options.formats),
                "every": options.choice.every,
                "fps": options.choice.fps,
                "with_attitude": found.with_attitude,
                **{k: view[k] for k in ("units", "origin", "up_is_known", "offset") if k in view},
                "flights": [
                    {"sequence": flight.source.sequence, "camera": flight.camera_source}
                    for flight in flights
                ],
                **facts,
            },
        )
        replace_folder(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    if stop is not None:
        raise PredictionStopped(found) from stop
    return found


class PredictionStopped(KeyboardInterrupt):
    """Raised after Ctrl-C; the folder holds the poses so far.

    Attributes
    ----------
    predicted : Predicted
        What was written.
    """

    def __init__(self, predicted: Predicted):
        super().__init__("stopped")
        self.predicted = predicted


def _estimate_batches(
    network: Checkpoint,
    flights: Sequence[Flight],
    views: ViewRenderers,
    progress: Progress,
    options: PredictOptions,
) -> Iterator[tuple[PoseRows, float, int]]:
    """Yield the rows of each batch, the seconds that the network took, and how many had an attitude."""
    for flight in flights:
        done, expected = 0, max(1, flight.expected_of(options.choice))
        for batch in _batches(frames(flight, views, options.choice), options.batch):
            verticals = [
                None if options.attitude is None else options.attitude.at(frame.time_s)
                for frame in batch
            ]
            rows, seconds = _estimate_batch(network, batch, verticals)
            done += len(batch)
            # The number of frames in the container may be wrong.
            progress(flight.source.sequence, done, max(expected, done))
            yield rows, seconds, sum(one is not None for one in verticals)


def _batches(found: Iterator[FlightFrame], size: int) -> Iterator[list[FlightFrame]]:
    """Yield batches of frames, in order."""
    batch: list[FlightFrame] = []
    for frame in found:
        batch.append(frame)
        if len(batch) >= size:
            yield batch
            batch = []
    if batch:
        yield batch


def _estimate_batch(
    network: Checkpoint, batch: Sequence[FlightFrame], verticals: Sequence[KnownVertical | None]
) -> tuple[PoseRows, float]:
    rows, seconds = PoseRows.unknown(batch), 0.0
    shows = [k for k, frame in enumerate(batch) if frame.image is not None]

    def size(k: int) -> tuple[int, ...]:
        image = batch[k].image
        assert image is not None
        return image.shape

    for _, group in groupby(shows, key=size):
        chosen = np.array(list(group))
        images = np.stack([frame.image for frame in (batch[k] for k in chosen)])
        matrices = np.stack([batch[k].matrix for k in chosen])
        started = time.perf_counter()
        up = [verticals[k] for k in chosen]
        estimates = network.model.estimate(images, matrices, up).moved_by(network.view.offset)
        seconds += time.perf_counter() - started
        rows.set_estimates(chosen, estimates)
    return rows, seconds


def _describe_world(network: Checkpoint) -> str:
    """Describe the world frame in one line."""
    o = network.view.origin
    if o is None:
        unit, offset = (
            "m" if network.view.units == "m" else "model (not metres)",
            network.view.offset,
        )
        added = f", including the network's offset {position_text(offset)}" if any(offset) else ""
        return f"units: {unit}; axes and origin of the map{added}"
    return (
        f"units: m; axes: east north up; origin: latitude {o.lat_deg:.10f} longitude {o.lon_deg:.10f} "
        f"height {o.alt_m:.4f} above {o.height_reference.value}"
    )
