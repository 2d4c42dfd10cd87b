"""Camera positions as GeoJSON (RFC 7946): one point per frame, with the camera's angles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from spn_data.exports.exported_frames import ExportedFrames
from spn_data.exports.geographic import geographic_poses
from spn_data.geometry.geodesy import HeightReference
from spn_data.storage.files import write_atomically


def write_geojson(folder: Path, frames: ExportedFrames) -> None:
    """Write `frames.geojson`.

    Parameters
    ----------
    folder : Path
        Folder of the export.
    frames : ExportedFrames
        Frames to export.

    Raises
    ------
    StageError
        If the map is not georegistered.

    Notes
    -----
    GeoJSON's third coordinate is a height above the ellipsoid, so it is written only if the heights refer
    to the ellipsoid. The properties `height_m` and `height_reference` are always written.
    """
    places = geographic_poses(frames, "GeoJSON")
    above_ellipsoid = places.reference == HeightReference.ELLIPSOID
    features: list[dict[str, Any]] = []
    for row, name in enumerate(frames.labels.names.tolist()):
        latitude, longitude = places.lat_lon_deg[row].tolist()
        height_m = round(float(places.height_m[row]), 4)
        # Ten decimals of a degree resolve a hundredth of a millimetre.
        coordinates = [round(longitude, 10), round(latitude, 10)]
        heading, pitch, roll = (round(a, 4) for a in places.heading_pitch_roll_deg[row].tolist())
        features.append(
            {
                "type": "Feature",
                "geometry": {
                    "type": "Point",
                    "coordinates": [*coordinates, height_m] if above_ellipsoid else coordinates,
                },
                "properties": {
                    "name": name,
                    "sequence": str(frames.labels.sequences[row]),
                    "role": "evaluation" if frames.is_evaluation[row] else "mapping",
                    "time_s": round(float(frames.labels.time_s[row]), 6),
                    "height_m": height_m,
                    "height_reference": places.reference.value,
                    "heading_deg": heading,
                    "pitch_deg": pitch,
                    "roll_deg": roll,
                },
            }
        )
    collection = {"type": "FeatureCollection", "features": features}
    text = json.dumps(collection, indent=1, allow_nan=False)
    write_atomically(folder / "frames.geojson", text + "\n")
