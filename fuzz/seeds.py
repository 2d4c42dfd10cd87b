"""Valid files that mutations start from: made by the project's own programs, and real ones where present.

python -m fuzz.seeds FOLDER
"""

from __future__ import annotations

import shutil
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from click.testing import CliRunner
from PIL import Image
from spn_cli.data import main as data_command
from spn_cli.model import main as model_command

from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import export
from spn_model.models import checkpoint
from spn_model.training.recipe import SHIPPED
from spn_model.training.training_state import Position, save_state
from tests.worlds import data_track_videos as tracks
from tests.worlds import log_files
from tests.worlds.box_world import write_box
from tests.worlds.bundle_world import LENS, learnt
from tests.worlds.short_flights import frames_of, write_flight1, write_video

SHARED = Path(__file__).resolve().parents[2] / "shared"
_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:AbsoluteAltitude="+120" '
    b'drone-dji:RelativeAltitude="+30.1" drone-dji:GimbalYawDegree="12.3" drone-dji:GimbalPitchDegree="-90" '
    b'drone-dji:GimbalRollDegree="+0.00" drone-dji:GpsLatitude="49.01" drone-dji:GpsLongitude="8.42" '
    b'drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.011" drone-dji:RtkStdLat="0.012" '
    b'drone-dji:RtkStdHgt="0.02"/></rdf:RDF></x:xmpmeta>'
)
_GPX = """<?xml version="1.0"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
{}
</trkseg></trk></gpx>
"""
_ASS = """[Script Info]
ScriptType: v4.00+

[Events]
Format: Layer, Start, End, Style, Name, MarginL, MarginR, MarginV, Effect, Text
{}
"""


def make(folder: Path) -> None:
    """Write the seeds, a folder for each subject, unless the folder is complete."""
    if (folder / "complete").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    _flight_and_area(folder)
    _network(folder)
    make_small(folder, folder / "flight" / "mapping")
    _copy_shared(folder)


def make_small(folder: Path, flight: Path) -> None:
    """Write the seeds that take a second in all: telemetry, photos and videos, also of a flight."""
    _telemetry(folder / "telemetry", flight)
    _control(folder / "control")
    _pictures(folder / "photos")
    _videos(folder / "video")
    _data_tracks(folder / "data-tracks")
    (folder / "complete").touch()


def _run(command: object, *arguments: object) -> None:
    result = CliRunner().invoke(command, [str(a) for a in arguments])  # type: ignore[arg-type]
    if result.exit_code:
        raise SystemExit(f"seeds: {arguments[0]}: {result.output}{result.exception!r}")


def _flight_and_area(folder: Path) -> None:
    """Simulate 9 s of flight, make an area of it with an evaluation sequence, data set and network."""
    area = folder / "area"
    flight = write_flight1(folder / "flight")
    _run(
        *(data_command, "reconstruct", flight, "--area", area),
        *("--max-features", 800, "--threads", 1, "--fov", 72),
    )
    again = folder / "again"
    again.mkdir()
    write_video(again / "again.mp4", frames_of(flight / "flight1.mp4")[3:11])
    _run(
        data_command,
        "register",
        again / "again.mp4",
        "--name",
        "again",
        "--all-frames",
        "--area",
        area,
    )
    _run(data_command, "register", "--all-frames", "--area", area)
    _run(data_command, "coverage", "--area", area)
    _run(data_command, "split", "--area", area)
    recipe = folder / "recipe" / "short.toml"
    recipe.parent.mkdir()
    shutil.copy(SHIPPED / "default.toml", recipe)
    _run(
        *(model_command, "train", "--area", area, "--images", 64, "--validations", 1),
        *("--threads", 1),
    )
    _run(model_command, "evaluate", "--run", "default", "--area", area, "--threads", 1)


def _control(folder: Path) -> None:
    folder.mkdir()
    rows = [(f"P{k // 2}", f"{9 + k // 2 * 1e-4:.6f}", f"DJI_{k % 2}.JPG") for k in range(8)]
    (folder / "gcp_list.txt").write_text(
        "EPSG:4326\n"
        + "".join(f"{lon} 48.5 210 9 20 {image} {name}\n" for name, lon, image in rows)
    )
    (folder / "points.csv").write_text(
        "name,lat,lon,height,epsg,image,x,y,role\n"
        + "".join(f"{name},48.5,{lon},210,4979,{image},9,20,check\n" for name, lon, image in rows)
    )


def _telemetry(folder: Path, flight: Path) -> None:
    folder.mkdir()
    shutil.copy(flight / "flight1.SRT", folder / "simulated.SRT")
    rows = range(20)
    (folder / "a.gpx").write_text(
        _GPX.format(
            "\n".join(
                f'<trkpt lat="{49 + k * 1e-5:.7f}" lon="8.42"><ele>{120 + k}</ele>'
                f"<time>2026-05-01T10:00:{k:02d}Z</time></trkpt>"
                for k in rows
            )
        )
    )
    (folder / "a.ass").write_text(
        _ASS.format(
            "\n".join(
                f"Dialogue: 0,0:00:{k:02d}.00,0:00:{k + 1:02d}.00,Default,,0,0,0,,"
                f"[latitude: {49 + k * 1e-5:.6f}] [longitude: 8.42] [rel_alt: 1.2 abs_alt: 120.5]"
                for k in rows
            )
        )
    )
    dialects = {
        "plain.csv": ("time_s,lat_deg,lon_deg,alt_m,yaw,pitch", "{k},{lat},8.42,120.5,12,-90"),
        "airdata.csv": (
            "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),"
            "gimbal_heading(degrees),gimbal_pitch(degrees)",
            "{ms},2026-05-01 10:00:{k:02d},{lat},8.42,100.1,12,-90",
        ),
        "px4.csv": (
            "time_us,lat,lon,alt,alt_ellipsoid,eph,epv",
            "{us},{e7},84200000,120500,168000,1.2,2",
        ),
        "semi.csv": (
            "time;latitude;longitude;altitude [m]",
            "2026-05-01T10:00:{k:02d}Z;{lat};8,42;120,5",
        ),
        "tab.tsv": ("time\tlat\tlon\tele", "2026-05-01 10:00:{k:02d}\t{lat}\t8.42\t120"),
    }
    for name, (header, row) in dialects.items():
        cells = [
            row.format(
                k=k, ms=1000 * k, us=10**6 * k + 10**9, lat=49 + k / 1e5, e7=490000000 + 100 * k
            )
            for k in rows
        ]
        (folder / name).write_text("\n".join([header, *cells]) + "\n")
    logged = log_files.make_flight(25)
    log_files.write_ulog(folder / "a.ulg", logged)
    log_files.write_dataflash(folder / "a.bin", logged)
    log_files.write_tlog(folder / "a.tlog", logged)
    log_files.write_fit(folder / "a.fit", logged)
    log_files.write_nmea(folder / "a.nmea", logged)
    (folder / "waypoints").mkdir()
    (folder / "waypoints" / "w.csv").write_text(
        "lat_deg,lon_deg,height_takeoff_m,heading_deg,pitch_deg\n49.0,8.4,30,90,-45\n49.001,8.4,31,9,-9\n"
    )


def _pictures(folder: Path) -> None:
    folder.mkdir()
    pixels = np.random.default_rng(1).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    image = Image.fromarray(cv2.GaussianBlur(pixels, (0, 0), 2))
    exif = Image.Exif()
    exif.update({0x010F: "DJI", 0x0110: "FC300S", 0x0112: 6, 0x0132: "2026:05:01 10:00:00"})
    exif.get_ifd(0x8769).update({0x9003: "2026:05:01 10:00:00", 0x920A: 3.6, 0xA405: 20})
    exif.get_ifd(0x8825).update(
        {
            1: "N",
            2: (49.0, 1.0, 5.5),
            3: "E",
            4: (8.0, 25.0, 1.5),
            5: b"\0",
            6: 120.5,
            7: (8.0, 0.0, 0.0),
        }
    )
    image.save(folder / "a.jpg", exif=exif, xmp=_XMP)
    image.save(folder / "a.png", exif=exif)
    image.save(folder / "a.tif", exif=exif)
    image.save(folder / "a.webp", exif=exif, xmp=_XMP)
    image.save(folder / "a.bmp")
    deep = (np.random.default_rng(2).integers(0, 65535, (48, 64))).astype(np.uint16)
    cv2.imwrite(str(folder / "deep.png"), deep)
    cv2.imwrite(str(folder / "deep.tif"), deep)
    masks = folder.parent / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / "m.png"), (deep > 30000).astype(np.uint8) * 255)


def _videos(folder: Path) -> None:
    """Write one short video in each container, and two with a stream of subtitles."""
    folder.mkdir()
    images = [np.full((48, 64, 3), 20 * k, np.uint8) for k in range(8)]
    for name in ("a.mp4", "a.mkv", "a.ts", "a.avi"):
        write_video(folder / name, images, "mpeg4" if name == "a.avi" else "libx264")
    subtitled = folder.parent / "subtitled"
    subtitled.mkdir()
    for name, codec in (("s.mp4", "mov_text"), ("s.mkv", "subrip")):
        with av.open(str(subtitled / name), "w") as container:
            stream = container.add_stream("libx264", rate=2)
            stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
            track = container.add_mux_stream(codec)
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
            container.mux(stream.encode())
            for k in range(len(images)):
                text = f"[latitude: {49 + k / 1e5}] [longitude: 8.42] [rel_alt: {k} abs_alt: 160.25]".encode()
                data = len(text).to_bytes(2, "big") + text if codec == "mov_text" else text
                packet = av.Packet(data)
                packet.stream, packet.time_base = track, Fraction(1, 1000)
                packet.pts = packet.dts = 500 * k
                packet.duration = 100
                container.mux(packet)


def _data_tracks(folder: Path) -> None:
    """Write videos with data tracks, and the payloads of these tracks."""
    payloads = {
        "gps5.gpmf": tracks.gps5_payload(3, reference=b"MSLV"),
        "gps9.gpmf": tracks.gps9_payload(),
        "karma.gpmf": tracks.karma_payload(),
        "full.camm": tracks.camm_packet(3),
        "misb.klv": tracks.misb_set(1_714_564_800_000_000, tracks.misb_items()),
    }
    (folder / "payloads").mkdir(parents=True)
    for name, payload in payloads.items():
        (folder / "payloads" / name).write_bytes(payload)
        video = (folder / name).with_suffix(".ts" if name.endswith("klv") else ".mp4")
        tracks.write_data_video(video, [(k / 2, payload) for k in range(4)], seconds=2.0)


def _network(folder: Path) -> None:
    """Write bundle, checkpoint, training state and parameters of a small network."""
    torch.set_num_threads(1)
    (folder / "box").mkdir()
    dataset = write_box(folder / "box" / "dataset.h5", train=4)
    network = learnt(dataset)
    bundle = folder / "bundle"
    export(network, dataset, bundle, {}, lambda *_: None, BundleOptions(calibration_images=4))
    (bundle / "camera.json").write_text(
        f'{{"model": "OPENCV", "width": 640, "height": 360, "params": {LENS.params.tolist()}}}'
    )
    cv2.imwrite(str(bundle / "image.jpg"), np.full((360, 640, 3), 90, np.uint8))
    run = folder / "run"
    run.mkdir()
    checkpoint.save(run / "checkpoint.safetensors", network.model, network.view, network.facts)
    save_state(run / "state.safetensors", network.model.network, None, Position())
    weights = folder / "weights"
    weights.mkdir()
    small = {name: t for name, t in list(network.model.network.state_dict().items())[:4]}
    torch.save(small, weights / "w.pth")


def _copy_shared(folder: Path) -> None:
    """Add real files if the folder of real data is next to the repository."""
    for path in sorted((SHARED / "data" / "srt").glob("*.[sS][rR][tT]")):
        lines = path.read_bytes().split(b"\n")[:400]
        (folder / "telemetry" / f"real-{path.name}").write_bytes(b"\n".join(lines))
    real = folder / "real-photos"
    real.mkdir()
    for path in sorted((SHARED / "data" / "photos-dji-xmp").glob("*.JPG"))[:2]:
        shutil.copy(path, real)
    base = SHARED / "cases" / "labels" / "base"
    for path in sorted(p for p in base.rglob("*") if p.is_file()):
        target = folder / "lists" / path.relative_to(base)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)


if __name__ == "__main__":
    make(Path(sys.argv[1]))
