"""ROS 2: pose, odometry and NavSatFix of each fix in a rosbag2 folder with MCAP storage."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.rotations import scalar_last
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.extras import optional
from spn_model.autopilot.frames import FRD_FROM_FLU, Mounting, body_pose
from spn_model.integrity.fix import Fix, NoFix

WORLD_FRAME, BODY_FRAME = "map", "base_link"  # REP 105
TOPICS = {
    "/spn/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/spn/odometry": "nav_msgs/msg/Odometry",
    "/spn/fix": "sensor_msgs/msg/NavSatFix",
}
_DISTRIBUTION = "ROS2_HUMBLE"  # these messages are the same in later ones
_BAG_VERSION = 9
_STATUS_FIX, _STATUS_NO_FIX, _SERVICE_UNKNOWN = 0, -1, 0
_COVARIANCE_UNKNOWN, _COVARIANCE_KNOWN = 0, 3
_UNKNOWN_TWIST = np.concatenate([[-1.0], np.zeros(35)])  # -1 in the first element: unknown


class Ros2Writer:
    """Writes the messages of fixes into a bag.

    Parameters
    ----------
    folder : Path
        Folder of the bag; it must not exist.
    mounting : Mounting
        How the camera is fixed to the body.
    datum : Datum or None
        Where the world is on the Earth; without it, no NavSatFix is written.

    Raises
    ------
    InputError
        If the folder exists or cannot be written, or if rosbags is not installed.

    Notes
    -----
    `map` is the world, East, North, Up; `base_link` is the body, forward, left, up (REP 103). Rotation
    covariances are about fixed axes of `map`. An image without a usable fix has no pose, and a NavSatFix that
    says so. A fix is logged at its exposure plus its processing time.
    """

    def __init__(self, folder: Path, *, mounting: Mounting, datum: Datum | None):
        bags = optional("rosbags.rosbag2", "ros2", "a ROS 2 bag")
        types = optional("rosbags.typesys", "ros2", "a ROS 2 bag")
        self._store = types.get_typestore(types.Stores[_DISTRIBUTION])
        self._mounting, self._datum, self._folder = mounting, datum, folder
        if folder.exists():
            raise InputError("already exists; choose another folder for the bag", path=folder)
        try:
            self._bag = bags.Writer(
                folder, version=_BAG_VERSION, storage_plugin=bags.StoragePlugin.MCAP
            )
            self._bag.open()
            self._connections = {
                topic: self._bag.add_connection(topic, kind, typestore=self._store)
                for topic, kind in TOPICS.items()
                if datum is not None or topic != "/spn/fix"
            }
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", path=folder) from error

    def send(self, item: Fix | NoFix) -> None:
        """Write the messages of one image."""
        log_ns = item.time_us * 1000 + round(item.processing_s * 1e9)
        if isinstance(item, NoFix) or not item.usable:
            if self._datum is not None:
                nothing = self._nav_sat_fix(item.time_us, _STATUS_NO_FIX, (math.nan,) * 3, None)
                self._write("/spn/fix", log_ns, nothing)
            return
        body = body_pose(item, self._mounting)
        pose = body.with_body_axes(FRD_FROM_FLU)
        with_covariance = self._message(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=self._message(
                "geometry_msgs/msg/Pose",
                position=self._message(
                    "geometry_msgs/msg/Point", **dict(zip("xyz", pose.position, strict=True))
                ),
                orientation=self._message(
                    "geometry_msgs/msg/Quaternion",
                    **dict(zip("xyzw", scalar_last(pose.quat_wxyz), strict=True)),
                ),
            ),
            covariance=pose.fixed_axis_covariance().ravel(),
        )
        header = self._header(item.time_us, WORLD_FRAME)
        self._write(
            "/spn/pose",
            log_ns,
            self._message(TOPICS["/spn/pose"], header=header, pose=with_covariance),
        )
        self._write(
            "/spn/odometry",
            log_ns,
            self._message(
                TOPICS["/spn/odometry"],
                header=header,
                child_frame_id=BODY_FRAME,
                pose=with_covariance,
                twist=self._unknown_twist(),
            ),
        )
        if self._datum is not None:
            place = self._datum.geodetic(body.position)
            where = (place.lat_deg, place.lon_deg, place.ellipsoid_m)
            message = self._nav_sat_fix(
                item.time_us, _STATUS_FIX, where, body.covariance[:3, :3].ravel()
            )
            self._write("/spn/fix", log_ns, message)

    def close(self) -> None:
        """Finish the bag: without this, its index is missing."""
        try:
            self._bag.close()
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", path=self._folder) from error

    def _nav_sat_fix(
        self,
        time_us: int,
        status: int,
        place: tuple[float, float, float],
        covariance: np.ndarray | None,
    ) -> Any:
        return self._message(
            TOPICS["/spn/fix"],
            header=self._header(time_us, BODY_FRAME),
            status=self._message(
                "sensor_msgs/msg/NavSatStatus", status=status, service=_SERVICE_UNKNOWN
            ),
            latitude=place[0],
            longitude=place[1],
            altitude=place[2],
            position_covariance=np.zeros(9) if covariance is None else covariance,
            position_covariance_type=_COVARIANCE_UNKNOWN
            if covariance is None
            else _COVARIANCE_KNOWN,
        )

    def _unknown_twist(self) -> Any:
        nothing = self._message("geometry_msgs/msg/Vector3", x=math.nan, y=math.nan, z=math.nan)
        return self._message(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=self._message("geometry_msgs/msg/Twist", linear=nothing, angular=nothing),
            covariance=_UNKNOWN_TWIST,
        )

    def _header(self, time_us: int, frame: str) -> Any:
        seconds, rest = divmod(time_us, 1_000_000)
        if seconds >= 2**31:
            raise InputError(f"the time {time_us} us does not fit into a ROS 2 stamp")
        stamp = self._message("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest * 1000)
        return self._message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _message(self, kind: str, **values: Any) -> Any:
        return self._store.types[kind](**values)

    def _write(self, topic: str, log_ns: int, message: Any) -> None:
        data = self._store.serialize_cdr(message, TOPICS[topic])
        try:
            self._bag.write(self._connections[topic], log_ns, data)
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", path=self._folder) from error
