"""Camera positions as KML 2.2 for Google Earth: one folder per sequence, with its path and its frames."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path

from spn_data.exports.exported_frames import ExportedFrames
from spn_data.exports.geographic import GeographicPoses, geographic_poses
from spn_data.geometry.geodesy import HeightReference
from spn_data.storage.files import write_atomically

# KML's absolute altitudes refer to mean sea level; it has no ellipsoidal heights.
_MODES = {
    HeightReference.AMSL: ("absolute", "drawn at that height"),
    HeightReference.TAKEOFF: (
        "relativeToGround",
        "drawn above the local ground, which is correct only if it is level with the take-off point",
    ),
    HeightReference.ELLIPSOID: (
        "clampToGround",
        "drawn on the ground, because KML's altitudes refer to mean sea level",
    ),
    HeightReference.UNKNOWN: ("clampToGround", "drawn on the ground"),
}


def write_kml(folder: Path, frames: ExportedFrames) -> None:
    """Write `frames.kml`; raise StageError if the map is not georegistered."""
    text = "\n".join(_text(frames, geographic_poses(frames, "KML")))
    write_atomically(folder / "frames.kml", text + "\n")


def _text(frames: ExportedFrames, places: GeographicPoses) -> Iterator[str]:
    mode, drawn = _MODES[places.reference]
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    yield (
        f"<name>Camera poses</name><description>Heights in metres, reference: "
        f"{places.reference.value}; {drawn}. Headings in degrees clockwise from north.</description>"
    )
    yield '<Style id="mapping"><LineStyle><color>ff00a5ff</color><width>2</width></LineStyle></Style>'
    yield '<Style id="evaluation"><LineStyle><color>ffff8000</color><width>2</width></LineStyle></Style>'
    for sequence, rows in frames.sequences():
        role = "evaluation" if frames.is_evaluation[rows[0]] else "mapping"
        yield f"<Folder><name>{escape(sequence)}</name><description>{role}</description>"
        if len(rows) > 1:
            yield (
                f"<Placemark><name>{escape(sequence)}</name><styleUrl>#{role}</styleUrl><LineString>"
                f"<altitudeMode>{mode}</altitudeMode><coordinates>"
                f"{' '.join(_coordinates(places, row) for row in rows)}"
                "</coordinates></LineString></Placemark>"
            )
        for row in rows:
            yield _placemark(frames, places, int(row), mode)
        yield "</Folder>"
    yield "</Document></kml>"


def _placemark(frames: ExportedFrames, places: GeographicPoses, row: int, mode: str) -> str:
    heading, pitch, roll = places.heading_pitch_roll_deg[row]
    values = {
        "time_s": f"{frames.labels.time_s[row]:.6f}",
        "height_m": f"{places.height_m[row]:.4f}",
        "height_reference": places.reference.value,
        "heading_deg": f"{heading:.4f}",
        "pitch_deg": f"{pitch:.4f}",
        "roll_deg": f"{roll:.4f}",
    }
    data = "".join(
        f'<Data name="{name}"><value>{value}</value></Data>' for name, value in values.items()
    )
    tilt = pitch + 90  # KML's tilt is zero looking straight down
    return (
        f"<Placemark><name>{escape(str(frames.labels.names[row]))}</name>"
        f"<Camera>{_location(places, row)}<heading>{heading:.4f}</heading><tilt>{tilt:.4f}</tilt>"
        f"<altitudeMode>{mode}</altitudeMode></Camera>"
        f"<ExtendedData>{data}</ExtendedData>"
        f"<Point><altitudeMode>{mode}</altitudeMode><coordinates>{_coordinates(places, row)}"
        "</coordinates></Point></Placemark>"
    )


def _location(places: GeographicPoses, row: int) -> str:
    latitude, longitude = places.lat_lon_deg[row]
    return (
        f"<longitude>{longitude:.10f}</longitude><latitude>{latitude:.10f}</latitude>"
        f"<altitude>{places.height_m[row]:.4f}</altitude>"
    )


def _coordinates(places: GeographicPoses, row: int) -> str:
    """Format longitude, latitude and height; ten decimals of a degree resolve 0.01 mm."""
    latitude, longitude = places.lat_lon_deg[row]
    return f"{longitude:.10f},{latitude:.10f},{places.height_m[row]:.4f}"
