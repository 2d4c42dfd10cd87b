"""Poses of any images by a trained network: streamed, with covariance, and never one that was not found."""

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
from spn_data.storage.files import replace_folder, write_atomically
from spn_data.storage.json_files import write_json
from spn_data.work.timing import Progress
from spn_model.models.checkpoint import Checkpoint
from spn_model.prediction.flown import Flight, FlownFrame, FrameFilter, Views, frames
from spn_model.prediction.predicted_files import PoseTable, Rows, tum_texts, write_wgs84

VERSION = 1
RECORD, POSES, WGS84, TUM = "predict.json", "poses.csv", "wgs84.csv", "tum"
FORMATS = ("csv", "tum", "wgs84")


@dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """What is written of which frames."""

    choice: FrameFilter = field(default_factory=FrameFilter)
    formats: tuple[str, ...] = ("csv",)  # of FORMATS; the CSV is always there
    batch: int = 8  # images given to the network at once


@dataclass(frozen=True, kw_only=True)
class Predicted:
    """What was written. counts : frames by status; reasons : of failures, most frequent first.

    complete : all frames were done; seen : least share of the network's view that a camera filled;
    seconds : of the network alone.
    """

    folder: Path
    counts: Mapping[str, int]
    reasons: Sequence[tuple[str, int]]
    complete: bool
    seen: float
    seconds: float


def check_target(folder: Path, *, overwrite: bool) -> None:
    """Raises StageError unless the folder is free, or poses of ours that may be replaced."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise StageError(f"{folder} is not a folder; name another with --to")
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not (folder / RECORD).is_file():
        raise StageError(
            f"{folder} holds files that are no predicted poses; name another folder with --to"
        )
    if not overwrite:
        raise StageError(f"{folder} holds predicted poses already; --overwrite replaces them")


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
    """Write poses of all chosen frames to a folder, which appears whole.

    Stopped by Ctrl-C, it appears with the frames done so far, marked as incomplete. facts : what predict.json
    tells besides. Raises StageError where the folder holds something else, where the disk is full, and for
    WGS84 in a world without a place.
    """
    options = options or PredictOptions()
    check_target(folder, overwrite=overwrite)
    origin = network.view.origin
    if "wgs84" in options.formats and origin is None:
        raise StageError(
            "wgs84 needs a place in the world, and the network was trained in one without: its poses are "
            "in the map's own frame; write csv or tum, or georegister the area and train anew"
        )
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    views = Views(network.view)
    seconds = 0.0
    try:
        with PoseTable(partial / POSES) as table:
            complete, stop = False, None
            try:
                for rows, took in _estimated(network, flights, views, progress, options):
                    table.add(rows)
                    seconds += took
                complete = True
            except KeyboardInterrupt as error:
                stop = error
            done = table.rows()
        if "tum" in options.formats:
            world = _world(network)
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
                **{name: view[name] for name in ("units", "origin", "up_is_known")},
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
    """Raised where Ctrl-C ended the work; what was done stands in the folder."""

    def __init__(self, predicted: Predicted):
        super().__init__("stopped")
        self.predicted = predicted


def _estimated(
    network: Checkpoint,
    flights: Sequence[Flight],
    views: Views,
    progress: Progress,
    options: PredictOptions,
) -> Iterator[tuple[Rows, float]]:
    """Rows of a batch after the other, and the seconds that the network took."""
    for flight in flights:
        done, expected = 0, max(1, flight.expected // options.choice.every)
        for batch in _batches(frames(flight, views, options.choice), options.batch):
            rows, seconds = _of_batch(network, batch)
            done += len(batch)
            # A container's count of frames may be wrong.
            progress(flight.source.sequence, done, max(expected, done))
            yield rows, seconds


def _batches(found: Iterator[FlownFrame], size: int) -> Iterator[list[FlownFrame]]:
    """In order; images of a batch have one size."""
    batch: list[FlownFrame] = []
    for frame in found:
        batch.append(frame)
        if len(batch) >= size:
            yield batch
            batch = []
    if batch:
        yield batch


def _of_batch(network: Checkpoint, batch: Sequence[FlownFrame]) -> tuple[Rows, float]:
    rows, seconds = Rows.unknown(batch), 0.0
    shows = [k for k, frame in enumerate(batch) if frame.image is not None]

    def size(k: int) -> tuple[int, ...]:
        image = batch[k].image
        assert image is not None
        return image.shape

    for _, group in groupby(shows, key=size):
        of = np.array(list(group))
        images = np.stack([frame.image for frame in (batch[k] for k in of)])
        matrices = np.stack([batch[k].matrix for k in of])
        started = time.perf_counter()
        estimates = network.model.estimate(images, matrices)
        seconds += time.perf_counter() - started
        rows.put(of, estimates)
    return rows, seconds


def _world(network: Checkpoint) -> str:
    """The world frame in one line."""
    o = network.view.origin
    if o is None:
        unit = "m" if network.view.units == "m" else "model (not metres)"
        return f"units: {unit}; axes and origin of the map"
    return (
        f"units: m; axes: east north up; origin: latitude {o.lat_deg:.10f} longitude {o.lon_deg:.10f} "
        f"height {o.alt_m:.4f} above {o.height_reference.value}"
    )
