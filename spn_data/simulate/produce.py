"""Rendering of the flights into videos, together with telemetry and ground truth."""

from __future__ import annotations

import multiprocessing
import os
import shutil
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
from spn_data.simulate.place import SceneFaces
from spn_data.simulate.presets import SimulateOptions
from spn_data.simulate.render import BAND_PX, SceneRenderer
from spn_data.simulate.scene import build_scene, paint
from spn_data.simulate.srt import srt_text
from spn_data.simulate.truth import write_options, write_truth
from spn_data.simulate.video_out import develop, noise_field, write_video
from spn_data.storage.files import LOCK, locked
from spn_data.work.parallel import exit_with_parent, interrupts_blocked

Progress = Callable[[int, int], None]


def simulate(
    out: Path,
    options: SimulateOptions,
    progress: Progress | None = None,
    *,
    workers: int | None = None,
) -> None:
    """Write `mapping/`, `evaluation/` and `truth/` to a new folder.

    Parameters
    ----------
    out : Path
        Folder to create; it appears only when complete.
    options : SimulateOptions
        What to simulate.
    progress : callable, optional
        Called with the number of rendered frames and the total number of frames.
    workers : int, optional
        Number of rendering processes; one per core by default, 1 renders in this process. The result does
        not depend on it.

    Raises
    ------
    StageError
        If `out` already exists or cannot be created.
    InputError
        If the options name an unknown flight.
    """
    paths = simulate_paths(options)
    if out.exists():
        raise StageError(f"{out} already exists; choose another folder or remove it first")
    try:
        partial = out.with_name(f".{out.name}.partial")
        partial.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StageError(f"{out}: cannot be created ({error})") from error
    with locked(partial, "spn-data simulate"):
        _remove_files(partial)  # of a run that was killed
        try:
            _produce(partial, options, paths, progress, workers or os.cpu_count() or 1)
            if out.exists():
                raise StageError(
                    f"{out} was created by another process while rendering; nothing was written to it"
                )
            (partial / LOCK).unlink()
            partial.rename(out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _remove_files(partial: Path) -> None:
    for entry in partial.iterdir():
        if entry.name != LOCK:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


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
    scene = build_scene(options.scene)
    with _RenderPool(options, texture_folder, workers) as pool:
        for _ in pool.map(_paint_texture, [(name,) for name in scene.canvases]):
            pass
        for path in paths.values():

            def frames(path: FlightPath = path) -> Iterator[np.ndarray]:
                nonlocal done
                for image in pool.map(_render, [(path.name, i) for i in range(len(path.time_s))]):
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


class _RenderContext:
    """Rendering state of one process: textures mapped from files, and one renderer per camera."""

    def __init__(self, options: SimulateOptions, texture_folder: Path):
        cv2.setNumThreads(1)
        self.options = options
        self.texture_folder = texture_folder
        self.scene: SceneFaces = build_scene(options.scene)
        self.paths = simulate_paths(options)
        self.noise = noise_field(options.width, options.height, options.noise_sigma, options.seed)
        self._textures: dict[str, Texture] = {}
        self._renderers: dict[str, SceneRenderer] = {}

    def renderer(self, path: FlightPath) -> SceneRenderer:
        """Return the renderer for a flight's camera."""
        if not self._textures:
            self._textures = {
                name: _open_texture(self.texture_folder, name) for name in self.scene.canvases
            }
        if path.role not in self._renderers:
            self._renderers[path.role] = SceneRenderer(
                self.scene.faces, self._textures, path.camera
            )
        return self._renderers[path.role]


def _open_texture(folder: Path, name: str) -> Texture:
    count = len(list(folder.glob(f"{name}.*.npy")))
    files = [folder / f"{name}.{k}.npy" for k in range(count)]
    # Large levels are shared between processes. Each memory map holds a file open, whose number is limited.
    levels = [
        np.load(file, mmap_mode="r") if file.stat().st_size > 4e6 else np.load(file)
        for file in files
    ]
    return Texture(tuple(np.asarray(level) for level in levels))


def _paint_texture(context: _RenderContext, name: str) -> None:
    texture = Texture.from_image(paint(context.scene, name))
    for k, level in enumerate(texture.levels):
        np.save(context.texture_folder / f"{name}.{k}.npy", level)


def _render(context: _RenderContext, flight: str, frame: int) -> np.ndarray:
    path = context.paths[flight]
    image = render_frame(context.renderer(path), path, frame, context.options.readout_s)
    rng = flight_rng(context.options, flight, 1000 + frame)
    return develop(
        image,
        lens_blur_px=context.options.lens_blur_px,
        exposure_ev=float(path.exposure_ev[frame]),
        noise=context.noise,
        rng=rng,
    )


def render_frame(
    renderer: SceneRenderer, path: FlightPath, frame: int, readout_s: float = 0.0
) -> np.ndarray:
    """Render one frame (H, W, 3) uint8 RGB of a flight, before exposure and noise."""
    renderer.set_time(path.clock_s + path.time_s[frame], path.sunlight)
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


# State of this worker process; a pool's initializer can keep it only in a global.
_context: _RenderContext | None = None


def _init_worker(options: SimulateOptions, texture_folder: Path, parent_pid: int) -> None:
    global _context
    exit_with_parent(parent_pid)
    _context = _RenderContext(options, texture_folder)


def _run_in_worker(task: Callable[..., Any], args: tuple[object, ...]) -> Any:
    assert _context is not None
    return task(_context, *args)


class _RenderPool:
    """Processes that paint and render; with one worker, the current process."""

    def __init__(self, options: SimulateOptions, texture_folder: Path, workers: int):
        self._workers = workers
        self._context: _RenderContext | None = None
        self._pool: ProcessPoolExecutor | None = None
        if workers == 1:
            self._context = _RenderContext(options, texture_folder)
        else:
            self._pool = ProcessPoolExecutor(
                workers,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_init_worker,
                initargs=(options, texture_folder, os.getpid()),
            )

    def __enter__(self) -> _RenderPool:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, task: Callable[..., Any], arguments: list[tuple[object, ...]]) -> Iterator[Any]:
        """Yield results in order, with a limited number of tasks submitted ahead."""
        if self._pool is None:
            for args in arguments:
                yield task(self._context, *args)
            return
        pending: deque[Future[Any]] = deque()
        for args in arguments:
            with interrupts_blocked():  # it starts processes
                pending.append(self._pool.submit(_run_in_worker, task, args))
            if len(pending) > 4 * self._workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
