"""Renders the flights of a scene into videos, with telemetry and truth beside them."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.errors import StageError
from spn_data.simulate.faces import Texture
from spn_data.simulate.flight import (
    FlightPath,
    exposure_poses,
    flight_rng,
    simulate_paths,
    simulate_telemetry,
)
from spn_data.simulate.presets import SimulateOptions
from spn_data.simulate.render import BAND_PX, SceneRenderer
from spn_data.simulate.scene import SceneFaces, build_place, paint
from spn_data.simulate.srt import srt_text
from spn_data.simulate.truth import write_options, write_truth
from spn_data.simulate.video_out import develop, noise_field, write_video
from spn_data.work.parallel import exit_with_parent

Progress = Callable[[int, int], None]


def simulate(
    out: Path,
    options: SimulateOptions,
    progress: Progress | None = None,
    *,
    workers: int | None = None,
) -> None:
    """Write `mapping/`, `evaluation/` and `truth/` into a new folder `out`.

    progress : called with (frames done, frames in all). workers : processes that render; None is one a
    core, 1 renders in this process. The result does not depend on it. The folder appears when it is
    complete. Raises StageError where `out` exists or cannot be made.
    """
    paths = simulate_paths(options)
    if out.exists():
        raise StageError(f"{out} exists: name another folder, or remove it first")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.partial-", dir=out.parent))
    except OSError as error:
        raise StageError(f"{out}: cannot be made ({error})") from error
    try:
        _produce(partial, options, paths, progress, workers or os.cpu_count() or 1)
        partial.chmod(0o755)  # mkdtemp's is for its owner alone
        if out.exists():
            raise StageError(f"{out} has appeared while rendering: nothing was written there")
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _produce(
    folder: Path,
    options: SimulateOptions,
    paths: dict[str, FlightPath],
    progress: Progress | None,
    workers: int,
) -> None:
    texture_folder = folder / "textures"
    for name in ("truth", "textures", *sorted({path.role for path in paths.values()})):
        (folder / name).mkdir()
    write_options(folder / "truth", options)
    total, done = sum(len(path.time_s) for path in paths.values()), 0
    place = build_place(options.scene)
    with _Crew(options, texture_folder, workers) as crew:
        for _ in crew.map(_paint_to, [(name,) for name in place.canvases]):
            pass
        for path in paths.values():

            def frames(path: FlightPath = path) -> Iterator[np.ndarray]:
                nonlocal done
                for image in crew.map(_render, [(path.name, i) for i in range(len(path.time_s))]):
                    yield image
                    done += 1
                    if progress is not None:
                        progress(done, total)

            write_video(
                folder / path.role / f"{path.name}.mp4",
                frames(),
                width=options.width,
                height=options.height,
                fps=options.fps,
                crf=options.crf,
            )
            text = srt_text(simulate_telemetry(path, options), options.fps)
            (folder / path.role / f"{path.name}.SRT").write_text(text, encoding="utf-8")
            write_truth(folder / "truth", path)
    shutil.rmtree(texture_folder)


class _Studio:
    """What one process holds to render: textures mapped from files, one renderer for each camera."""

    def __init__(self, options: SimulateOptions, texture_folder: Path):
        cv2.setNumThreads(1)
        self.options = options
        self.texture_folder = texture_folder
        self.place: SceneFaces = build_place(options.scene)
        self.paths = simulate_paths(options)
        self.noise = noise_field(options.width, options.height, options.noise_sigma, options.seed)
        self._textures: dict[str, Texture] = {}
        self._renderers: dict[str, SceneRenderer] = {}

    def renderer(self, path: FlightPath) -> SceneRenderer:
        """The renderer of a flight's camera."""
        if not self._textures:
            self._textures = {
                name: _open_texture(self.texture_folder, name) for name in self.place.canvases
            }
        if path.role not in self._renderers:
            self._renderers[path.role] = SceneRenderer(
                self.place.faces, self._textures, path.camera
            )
        return self._renderers[path.role]


def _open_texture(folder: Path, name: str) -> Texture:
    count = len(list(folder.glob(f"{name}.*.npy")))
    files = [folder / f"{name}.{k}.npy" for k in range(count)]
    # Large levels are shared between processes; each mapping holds a file open, and of these there are few.
    levels = [
        np.load(file, mmap_mode="r") if file.stat().st_size > 4e6 else np.load(file)
        for file in files
    ]
    return Texture(tuple(np.asarray(level) for level in levels))


def _paint_to(studio: _Studio, name: str) -> None:
    texture = Texture.from_image(paint(studio.place, name))
    for k, level in enumerate(texture.levels):
        np.save(studio.texture_folder / f"{name}.{k}.npy", level)


def _render(studio: _Studio, flight: str, frame: int) -> np.ndarray:
    path = studio.paths[flight]
    image = render_frame(studio.renderer(path), path, frame, studio.options.readout_s)
    rng = flight_rng(studio.options, flight, 1000 + frame)
    return develop(
        image,
        lens_blur_px=studio.options.lens_blur_px,
        exposure_ev=float(path.exposure_ev[frame]),
        noise=studio.noise,
        rng=rng,
    )


def render_frame(
    renderer: SceneRenderer, path: FlightPath, frame: int, readout_s: float = 0.0
) -> np.ndarray:
    """One frame (H, W, 3) uint8 RGB of a flight, before exposure and noise."""
    blurred = bool(path.blurred[frame])
    if readout_s == 0.0:
        if blurred:
            exposure = exposure_poses(path, frame)
            return renderer.render_exposure(exposure.centers, exposure.rotations)
        return renderer.render(path.poses.centers[frame], path.poses.rotations[frame])
    height = path.camera.height
    starts = np.arange(0, height, BAND_PX)
    rows = (starts + np.minimum(starts + BAND_PX, height)) / 2
    bands = path.motion.poses(path.time_s[frame] + (rows / height - 0.5) * readout_s)
    if not blurred:
        return renderer.render_rolling(bands.centers, bands.rotations)
    middle = path.poses.rotations[frame]
    turns = exposure_poses(path, frame).rotations @ middle.T
    images = [renderer.render_rolling(bands.centers, turn @ bands.rotations) for turn in turns]
    return np.rint(np.mean(images, axis=0, dtype=np.float32)).astype(np.uint8)


_studio: _Studio | None = (
    None  # of this worker process; a pool's initializer has nowhere else to put it
)


def _open_studio(options: SimulateOptions, texture_folder: Path, parent_pid: int) -> None:
    global _studio
    # Ctrl-C reaches every process of the terminal; the parent alone answers it, and ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    exit_with_parent(parent_pid)
    _studio = _Studio(options, texture_folder)


def _in_studio(task: Callable[..., Any], args: tuple[object, ...]) -> Any:
    assert _studio is not None
    return task(_studio, *args)


class _Crew:
    """Processes that paint and render; with one worker, this process itself."""

    def __init__(self, options: SimulateOptions, texture_folder: Path, workers: int):
        self._workers = workers
        self._studio: _Studio | None = None
        self._pool: ProcessPoolExecutor | None = None
        if workers == 1:
            self._studio = _Studio(options, texture_folder)
        else:
            self._pool = ProcessPoolExecutor(
                workers,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_open_studio,
                initargs=(options, texture_folder, os.getpid()),
            )

    def __enter__(self) -> _Crew:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, task: Callable[..., Any], arguments: list[tuple[object, ...]]) -> Iterator[Any]:
        """Results in order, with a few tasks under way ahead of the one awaited."""
        if self._pool is None:
            for args in arguments:
                yield task(self._studio, *args)
            return
        pending: deque[Future[Any]] = deque()
        for args in arguments:
            pending.append(self._pool.submit(_in_studio, task, args))
            if len(pending) > 4 * self._workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
