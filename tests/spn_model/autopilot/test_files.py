"""Files of fixes: JSON lines, CSV and a ROS 2 bag, each read back by a reader that is not the writer."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.rotations import rotations_from_quats
from spn_model.autopilot import extras
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.link import open_link
from spn_model.autopilot.ros2 import Ros2Writer
from spn_model.autopilot.writers import COLUMNS, open_writer
from spn_model.integrity.fix import FixState, NoFix
from tests.worlds.autopilots import AMSL_ONLY, DATUM, NOW_US, ORIGIN, make_fix

NOTHING = NoFix(
    time_us=NOW_US, state=FixState.SEARCH, reason="too dark, and covered", processing_s=0.25
)
FIX = make_fix(heading_pitch_roll_deg=[90.0, -10.0, 0.0])
WAITING = make_fix(state=FixState.CONFIRM)
MOUNTING = Mounting.pitched(-10.0, np.array([0.5, 0.0, 0.0]))


def written(path, *items, datum=DATUM):
    """Write results into a file and return its text."""
    writer = open_writer(path, datum=datum, mounting=MOUNTING)
    for item in items:
        writer.send(item)
        assert path.read_text().count("\n") >= 1  # nothing is held back
    writer.close()
    return path.read_text()


def test_json_lines_have_all_of_a_fix(tmp_path):
    """Each line is one object; what is unknown is null, and a failed image has its reason."""
    text = written(tmp_path / "fixes.jsonl", FIX, NOTHING, WAITING, datum=AMSL_ONLY)
    fix, nothing, waiting = (json.loads(line) for line in text.splitlines())
    assert fix["center"] == FIX.center.tolist()
    np.testing.assert_array_equal(fix["covariance"], FIX.covariance)
    assert (fix["state"], fix["usable"], fix["source"], fix["quality"]) == (
        "track",
        True,
        "track",
        80,
    )
    assert fix["time_us"] == FIX.time_us
    assert fix["horizontal_sigma_m"] == pytest.approx(0.3)
    place = ORIGIN.enu_from_wgs84(np.array([fix["lat_deg"], fix["lon_deg"], fix["amsl_m"]]))
    np.testing.assert_allclose(place, FIX.center, atol=1e-6)
    assert fix["ellipsoid_m"] is None
    assert nothing["reason"] == "too dark, and covered"
    assert nothing["center"] is nothing["lat_deg"] is nothing["covariance"] is None
    assert (nothing["usable"], waiting["usable"]) == (False, False)
    assert fix.keys() == nothing.keys()


def test_csv_has_the_same(tmp_path):
    """A CSV reader finds every column; numbers come back exactly, and unknown ones are empty."""
    text = written(tmp_path / "fixes.csv", FIX, NOTHING, datum=None)
    fix, nothing = csv.DictReader(text.splitlines())
    assert tuple(fix) == COLUMNS
    assert [float(fix[n]) for n in "xyz"] == FIX.center.tolist()
    assert [float(fix[n]) for n in ("qw", "qx", "qy", "qz")] == FIX.quat_wxyz.tolist()
    assert float(fix["cov_35"]) == FIX.covariance[3, 5]
    assert (fix["usable"], fix["lat_deg"], fix["amsl_m"]) == ("1", "", "")
    assert (nothing["usable"], nothing["reason"]) == ("0", "too dark, and covered")
    assert nothing["x"] == nothing["cov_00"] == nothing["quality"] == ""


def test_files_are_not_overwritten(tmp_path):
    """An existing file or bag, an unknown suffix and a folder that is not there are refused."""
    (tmp_path / "old.csv").write_text("mine")
    for path in (tmp_path / "old.csv", tmp_path):
        with pytest.raises(InputError, match="already exists"):
            open_writer(path, datum=None, mounting=MOUNTING).close()
    assert (tmp_path / "old.csv").read_text() == "mine"
    with pytest.raises(InputError, match=r"name it \.jsonl, \.csv, or a folder"):
        open_writer(tmp_path / "fixes.txt", datum=None, mounting=MOUNTING)
    with pytest.raises(InputError, match="cannot be written: No such file"):
        open_writer(tmp_path / "nowhere" / "fixes.csv", datum=None, mounting=MOUNTING)


def bag_messages(folder):
    """Read a bag with Foxglove's MCAP reader: topic, log time and message of each record."""
    reader = pytest.importorskip("mcap.reader", reason="the extra `readers` is not installed")
    decoder = pytest.importorskip(
        "mcap_ros2.decoder", reason="the extra `readers` is not installed"
    )
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as file:
        opened = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        return [
            (channel.topic, record.log_time, message)
            for _, channel, record, message in opened.iter_decoded_messages()
        ]


def write_bag(folder, *items, datum=DATUM, **options):
    """Write results into a bag."""
    pytest.importorskip("rosbags")
    writer = open_link("ros2", str(folder), mounting=MOUNTING, datum=datum, **options)
    for item in items:
        writer.send(item)
    writer.close()


def test_a_bag_has_pose_odometry_and_place(tmp_path):
    """In East-North-Up and with ROS's body axes: where the body is, how sure that is, and when."""
    write_bag(tmp_path / "bag", FIX)
    messages = bag_messages(tmp_path / "bag")
    found = {topic: message for topic, _, message in messages}
    assert set(found) == {"/spn/pose", "/spn/odometry", "/spn/fix"}
    assert {log for _, log, _ in messages} == {FIX.time_us * 1000 + 50_000_000}
    pose = found["/spn/pose"]
    assert pose.header.frame_id == "map"
    assert pose.header.stamp.sec * 10**6 + pose.header.stamp.nanosec // 1000 == FIX.time_us
    position = pose.pose.pose.position
    np.testing.assert_allclose(
        [position.x, position.y, position.z], FIX.center - [0.5, 0, 0], atol=1e-9
    )
    q = pose.pose.pose.orientation
    turned = rotations_from_quats(np.array([q.w, q.x, q.y, q.z]))
    np.testing.assert_allclose(turned, np.eye(3), atol=1e-9)  # forward is east, left is north
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    odometry = found["/spn/odometry"]
    assert odometry.child_frame_id == "base_link"
    np.testing.assert_array_equal(odometry.pose.covariance, pose.pose.covariance)
    assert math.isnan(odometry.twist.twist.linear.x)
    assert odometry.twist.covariance[0] == -1
    fix = found["/spn/fix"]
    assert (fix.status.status, fix.position_covariance_type) == (0, 3)
    ellipsoidal = GeoOrigin(ORIGIN.lat_deg, ORIGIN.lon_deg, ORIGIN.alt_m + 45.5)
    place = ellipsoidal.enu_from_wgs84(np.array([fix.latitude, fix.longitude, fix.altitude]))
    np.testing.assert_allclose(place, FIX.center - [0.5, 0, 0], atol=1e-3)
    np.testing.assert_allclose(fix.position_covariance, covariance[:3, :3].ravel())


def test_a_bag_says_when_there_is_no_fix(tmp_path):
    """An image without a usable fix has no pose, and a NavSatFix that says so and has no place."""
    write_bag(tmp_path / "bag", NOTHING, WAITING)
    messages = bag_messages(tmp_path / "bag")
    assert [topic for topic, _, _ in messages] == ["/spn/fix"] * 2
    for _, _, message in messages:
        assert message.status.status == -1
        assert math.isnan(message.latitude)
        assert message.position_covariance_type == 0


def moving(k: int, state: FixState = FixState.TRACK):
    """Return the fix of an image, 5 in a second, of a camera that flies 2 m/s to the east."""
    return make_fix(
        time_us=NOW_US + 200_000 * k, center=FIX.center + np.array([0.4 * k, 0, 0]), state=state
    )


def test_a_bag_has_predictions_between_images_on_their_own_topic(tmp_path):
    """From the second fix on, 30 in a second, along the motion, less sure than a fix; none after a loss."""
    lost = NoFix(time_us=NOW_US + 600_000, state=FixState.LOST, reason="x", processing_s=0.0)
    later = NoFix(time_us=NOW_US + 1_200_000, state=FixState.LOST, reason="x", processing_s=0.0)
    write_bag(tmp_path / "bag", moving(0), moving(1), moving(2), lost, later)
    found = bag_messages(tmp_path / "bag")
    fixes = [message for topic, _, message in found if topic == "/spn/odometry"]
    between = [(log, message) for topic, log, message in found if topic == "/spn/predicted"]
    assert len(fixes) == 3
    logs = np.array([log for log, _ in between]) // 1000 - NOW_US
    assert len(logs) == pytest.approx(11, abs=1)  # 0.25 to 0.6 s, as a fix takes 0.05 s
    assert logs[0] >= 250_000
    assert logs[-1] < 600_000
    assert set(np.diff(logs)) <= {33_333}
    for (log, message), after in zip(between, logs, strict=True):
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert stamp == log
        east_m = message.pose.pose.position.x - fixes[0].pose.pose.position.x
        assert east_m == pytest.approx(2e-6 * after, abs=1e-6)
        assert message.pose.covariance[0] > 10 * fixes[0].pose.covariance[0]


def test_predictions_end_with_the_age_of_the_fix(tmp_path):
    """After half a second without any image they end; with --coast 0 there are none."""
    for coast_s, last_us in ((0.5, 700_000), (0.0, None)):
        folder = tmp_path / f"bag-{coast_s}"
        write_bag(folder, moving(0), moving(1), moving(20), coast_s=coast_s)
        logs = [log for topic, log, _ in bag_messages(folder) if topic == "/spn/predicted"]
        assert bool(logs) == (last_us is not None)
        if last_us is not None:
            assert last_us - 33_333 <= max(logs) // 1000 - NOW_US <= last_us
    with pytest.raises(InputError, match=r"predictions go out for 2\.0 s, not 0 to 1"):
        write_bag(tmp_path / "other", FIX, coast_s=2.0)
    assert not (tmp_path / "other").exists()


def test_a_world_without_a_place_has_no_navsatfix(tmp_path):
    """Without an origin there is a pose; with heights above take-off, the altitude is unknown."""
    write_bag(tmp_path / "bag", FIX, NOTHING, datum=None)
    assert {topic for topic, _, _ in bag_messages(tmp_path / "bag")} == {
        "/spn/pose",
        "/spn/odometry",
    }
    takeoff = Datum(origin=GeoOrigin(48.1, 11.6, 0.0, HeightReference.TAKEOFF))
    write_bag(tmp_path / "other", FIX, datum=takeoff)
    found = {topic: message for topic, _, message in bag_messages(tmp_path / "other")}
    assert math.isnan(found["/spn/fix"].altitude)


def test_the_bag_is_one_that_ros_plays(tmp_path):
    """The folder has metadata.yaml beside the MCAP file, as `ros2 bag play` wants it."""
    write_bag(tmp_path / "bag", FIX)
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "storage_identifier: mcap" in text
    assert "message_count: 3" in text


def test_times_beyond_ros_are_refused(tmp_path):
    """A time after 2038 does not fit into ROS 2's stamps."""
    pytest.importorskip("rosbags")
    writer = Ros2Writer(tmp_path / "bag", mounting=MOUNTING, datum=None)
    with pytest.raises(InputError, match="does not fit into a ROS 2 stamp"):
        writer.send(make_fix(time_us=2**31 * 1_000_000))
    writer.close()


def test_a_missing_package_has_its_command():
    """A package that is not installed is one line with the command that installs it."""
    with pytest.raises(InputError, match=r"a thing needs.*'squeezeposenet-toolkit\[some\]'"):
        extras.optional("no_such_package_at_all", "some", "a thing")
