"""Export as a kapture 1.1 dataset: sensors, their trajectories, and the images they recorded.

Poses are sensor from world: `qw qx qy qz` and the translation t = -R centre. Cameras use COLMAP's models
and parameters. https://github.com/naver/kapture/blob/main/kapture_format.adoc
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.exports.exported_frames import ExportedFrames, timestamps_us
from spn_data.storage.files import write_atomically

IMAGE_FOLDER = "sensors/records_data"
_VERSION = "# kapture format: 1.1"


def write_kapture(folder: Path, frames: ExportedFrames) -> None:
    """Write `sensors.txt`, `trajectories.txt` and `records_camera.txt` to the folder `sensors`.

    Parameters
    ----------
    folder : Path
        Folder of the export.
    frames : ExportedFrames
        Frames to export.

    Notes
    -----
    Each camera of each sequence is a sensor of its own, because sequences of one camera share timestamps:
    microseconds since the sequence's first frame (`timestamps_us`). There are no rigs, since no camera is
    fixed to another.
    """
    labels = frames.labels
    sensors: dict[str, str] = {}
    trajectories, records = [], []
    for sequence, rows in frames.sequences():
        keys = sorted(set(labels.cameras[rows].tolist()))
        for key in keys:
            sensor = sequence if len(keys) == 1 else f"{sequence}/{key}"
            camera = frames.cameras[key]
            params = ", ".join(repr(float(value)) for value in camera.params)
            sensors[sensor] = (
                f"{key}, camera, {camera.model}, {camera.width}, {camera.height}, {params}"
            )
            mine = rows[labels.cameras[rows] == key]
            _, translations = labels.poses[mine].to_cam_from_world()
            numbers = np.concatenate([labels.poses[mine].quats_wxyz, translations], axis=1)
            for k, stamp in enumerate(timestamps_us(labels.time_s[mine])):
                pose = ", ".join(repr(float(value)) for value in numbers[k])
                trajectories.append(f"{stamp}, {sensor}, {pose}")
                records.append(f"{stamp}, {sensor}, {labels.names[mine[k]]}")
    world_comment = f"# {frames.world}"
    tables = {
        "sensors": (
            "# sensor_id, name, sensor_type, [sensor_params]+",
            [f"{sensor}, {rest}" for sensor, rest in sensors.items()],
        ),
        "trajectories": ("# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz", trajectories),
        "records_camera": ("# timestamp, device_id, image_path", records),
    }
    (folder / IMAGE_FOLDER).mkdir(parents=True)
    for name, (head, rows_of_table) in tables.items():
        text = "\n".join([_VERSION, world_comment, head, *rows_of_table]) + "\n"
        write_atomically(folder / "sensors" / f"{name}.txt", text)
