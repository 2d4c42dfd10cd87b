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
from spn_model.autopilot.frames import FRD_FROM_FLU, BodyPose, Mounting, body_pose
from spn_model.integrity.coasting import RecentFixes, check_coast
from spn_model.integrity.fix import Fix, NoFix

WORLD_FRAME, BODY_FRAME = "map", "base_link"  # REP 105
TOPICS = {
    "/spn/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/spn/odometry": "nav_msgs/msg/Odometry",
    "/spn/fix": "sensor_msgs/msg/NavSatFix",
    "/spn/predicted": "nav_msgs/msg/Odometry",
}
_PERIOD_US = 33_333  # between predictions
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
    coast_s : float
        Age of the last fix up to which predicted poses are written, 0 to 1 s; 0: none.

    Raises
    ------
    InputError
        If the folder exists or cannot be written, `coast_s` is out of range, or rosbags is not installed.

    Notes
    -----
    `map` is the world, East, North, Up; `base_link` is the body, forward, left, up (REP 103). Rotation
    covariances are about fixed axes of `map`. An image without a usable fix has no pose, and a NavSatFix that
    says so. A fix is logged at its exposure plus its processing time. Between the logs of two images,
    predictions are written as a node would have sent them, 30 in a second, on a topic of their own: the
    messages have no field that marks them. As for an autopilot, all of one fix weigh no more than it does.
    """

    def __init__(
        self, folder: Path, *, mounting: Mounting, datum: Datum | None, coast_s: float = 0.5
    ):
        check_coast(coast_s)
        bags = optional("rosbags.rosbag2", "ros2", "a ROS 2 bag")
        types = optional("rosbags.typesys", "ros2", "a ROS 2 bag")
        self._store = types.get_typestore(types.Stores[_DISTRIBUTION])
        self._mounting, self._datum, self._folder = mounting, datum, folder
        self._coast_us, self._recent, self._logged_us = round(coast_s * 1e6), RecentFixes(), 0
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
        self._predict_until(log_ns // 1000)
        self._recent.follow(item)
        if isinstance(item, NoFix) or not item.usable:
            if self._datum is not None:
                nothing = self._nav_sat_fix(item.time_us, _STATUS_NO_FIX, (math.nan,) * 3, None)
                self._write("/spn/fix", log_ns, nothing)
            return
        body = body_pose(item, self._mounting)
        header = self._header(item.time_us, WORLD_FRAME)
        with_covariance = self._pose(body)
        self._write(
            "/spn/pose",
            log_ns,
            self._message(TOPICS["/spn/pose"], header=header, pose=with_covariance),
        )
        self._write("/spn/odometry", log_ns, self._odometry(header, with_covariance))
        if self._datum is not None:
            place = self._datum.geodetic(body.position)
            where = (place.lat_deg, place.lon_deg, place.ellipsoid_m)
            message = self._nav_sat_fix(
                item.time_us, _STATUS_FIX, where, body.covariance[:3, :3].ravel()
            )
            self._write("/spn/fix", log_ns, message)

    def _predict_until(self, log_us: int) -> None:
        """Write the predictions between the last image's log and this one's."""
        end_us = min(log_us, self._recent.last_us + self._coast_us + 1)
        first_us = -(-self._logged_us // _PERIOD_US) * _PERIOD_US
        shared_by = max(1, -(-self._coast_us // _PERIOD_US))
        for time_us in range(first_us, end_us, _PERIOD_US):
            found = self._recent.predicted(time_us, shared_by=shared_by)
            if found is not None:
                header = self._header(time_us, WORLD_FRAME)
                pose = self._pose(body_pose(found, self._mounting))
                self._write("/spn/predicted", time_us * 1000, self._odometry(header, pose))
        self._logged_us = log_us

    def _odometry(self, header: Any, pose: Any) -> Any:
        return self._message(
            TOPICS["/spn/odometry"],
            header=header,
            child_frame_id=BODY_FRAME,
            pose=pose,
            twist=self._unknown_twist(),
        )

    def _pose(self, body: BodyPose) -> Any:
        pose = body.with_body_axes(FRD_FROM_FLU)
        return self._message(
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
