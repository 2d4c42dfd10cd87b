"""Two short simulated flights over the same ground, small enough for an area within seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np

from spn_data.simulate import preset, simulate


def frames_of(video: Path) -> list[np.ndarray]:
    """Decode all frames of a video as BGR images."""
    with av.open(str(video)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


def write_video(path: Path, images: list[np.ndarray], codec: str = "libx264") -> None:
    """Encode BGR images as a video with 2 frames per second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=2)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())


def write_flight1(out: Path) -> Path:
    """Simulate a flight of 9 s at 320 x 180 below a folder; return the folder of its files."""
    options = replace(
        preset("standard", seed=3),
        width=320,
        height=180,
        fps=2.0,
        length_factor=0.12,
        texels_per_m=40.0,
        only=("flight1",),
    )
    simulate(out, options, workers=1)
    return out / "mapping"


def write_flight2(folder: Path, flight1: Path) -> Path:
    """Write most of the first flight, flown backwards, as flight2.mp4 and flight2.SRT; return the folder."""
    images = frames_of(flight1 / "flight1.mp4")
    write_video(folder / "flight2.mp4", images[:3:-1])
    records = [text.splitlines() for text in (flight1 / "flight1.SRT").read_text().split("\n\n")]
    records = [lines for lines in records if len(lines) > 2]
    turned = [[*a[:-1], b[-1]] for a, b in zip(records, records[:3:-1], strict=False)]
    text = "\n\n".join("\n".join(lines) for lines in turned)
    (folder / "flight2.SRT").write_text(text + "\n\n")
    return folder
