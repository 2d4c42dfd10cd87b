"""Render photos of a telephoto orbit around the simulated courtyard, to try its lens.

    python benchmarks/telephoto.py OUT [--widths 62] [--photos 40] [--error 0]
    spn-data reconstruct OUT/photos --area AREA --camera OUT/camera.json

The camera circles at 45 degrees above the horizon over half a turn, as far away as it must to see the whole
courtyard. `camera.json` has the true lens, its focal length multiplied by 1 + ERROR; `truth.csv` has the
camera centres. The photos have no metadata.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.simulate.place import SceneOptions
from spn_data.simulate.render import SceneRenderer
from spn_data.simulate.scene import build_scene, paint_all
from spn_data.simulate.video_out import develop, noise_field

_SEEN_M = 44.0  # width of the image at the courtyard
_ELEVATION_DEG = 45.0


def render_orbit(out: Path, camera: Camera, photos: int, turn_deg: float) -> None:
    """Render photos on an arc around the courtyard, and write their camera centres."""
    scene = build_scene(SceneOptions(texels_per_m=30.0, houses_per_hectare=60.0))
    renderer = SceneRenderer(scene.faces, paint_all(scene), camera)
    noise, rng = noise_field(camera.width, camera.height, 1.8, 1), np.random.default_rng(1)
    distance_m = _SEEN_M * camera.focal_px[0] / camera.width
    (out / "photos").mkdir(parents=True)
    lines = ["name,x,y,z"]
    for k, heading_deg in enumerate(np.linspace(0.0, turn_deg, photos)):
        (rotation,) = rotations_from_angles(np.array([[heading_deg, -_ELEVATION_DEG, 0.0]]))
        center = np.array([0.0, 0.0, 4.0]) - distance_m * rotation[2]
        image = develop(
            renderer.render(center, rotation),
            lens_blur_px=0.45,
            exposure_ev=0.0,
            noise=noise,
            rng=rng,
        )
        cv2.imwrite(str(out / "photos" / f"{k:03d}.jpg"), image[:, :, ::-1])
        lines.append(f"{k:03d}.jpg," + ",".join(f"{x:.4f}" for x in center))
    (out / "truth.csv").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path)
    parser.add_argument("--widths", type=float, default=62.0, help="focal length in image widths")
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--turn", type=float, default=180.0, help="degrees of the arc")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540))
    parser.add_argument(
        "--error", type=float, default=0.0, help="relative, of the stated focal length"
    )
    arguments = parser.parse_args()
    width, height = arguments.size
    focal_px = arguments.widths * width
    truth = Camera("SIMPLE_PINHOLE", width, height, np.array([focal_px, width / 2, height / 2]))
    render_orbit(arguments.out, truth, arguments.photos, arguments.turn)
    stated = Camera(
        "SIMPLE_PINHOLE",
        width,
        height,
        np.array([focal_px * (1 + arguments.error), width / 2, height / 2]),
    )
    (arguments.out / "camera.json").write_text(json.dumps(camera_to_json(stated)))
    Console().print(f"{arguments.photos} photos, f = {focal_px:.0f} px")


if __name__ == "__main__":
    main()
