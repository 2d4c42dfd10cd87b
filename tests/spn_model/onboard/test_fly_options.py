"""Options of `spn-onboard fly` for messages and parameter files."""

from __future__ import annotations

import pytest

from spn_model.autopilot.parameters import parameter_file
from spn_model.autopilot.profiles import Message
from spn_model.onboard.__main__ import main

WORDS = ["fly", "bundle", "flight.mp4", "--camera", "camera.json"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--profile", "px4"], parameter_file("px4")),
        (
            ["--profile", "px4", "--messages", "ODOMETRY", "--use-height"],
            parameter_file("px4", messages=(Message.ODOMETRY,), use_height=True),
        ),
        (["--profile", "ardupilot"], parameter_file("ardupilot")),
        (["--profile", "ros2"], parameter_file("ros2")),
    ],
)
def test_the_parameter_file_belongs_to_the_options(options, expected, tmp_path, capsys):
    """It is that of the profile and the messages, and is not written over; the flight has no bundle."""
    path = tmp_path / "receiver.params"
    assert main([*WORDS, *options, "--parameters", str(path)]) == 1
    assert "flight.mp4" in capsys.readouterr().err
    assert path.read_text() == expected
    assert main([*WORDS, *options, "--parameters", str(path)]) == 1
    assert "already exists" in capsys.readouterr().err


def test_a_link_to_ros_is_refused(capsys):
    """ROS 2 has no MAVLink: the message says what writes a bag."""
    assert main([*WORDS, "--profile", "ros2", "--mavlink", "udpout:127.0.0.1:1"]) == 1
    assert "--to writes a ROS 2 bag" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options",
    [[], ["--mavlink", "udpout:127.0.0.1:1", "--pre-arm"], ["--attitude", "a.csv"]],
)
def test_a_live_attitude_needs_a_link_of_its_own(options, capsys):
    """Without a link, beside a file, and before take-off there is none."""
    assert main([*WORDS, "--live-attitude", *options]) == 1
    assert "--live-attitude comes over --mavlink" in capsys.readouterr().err


def test_unknown_messages_are_refused(capsys):
    """Another message than the three is an error of the command line."""
    with pytest.raises(SystemExit):
        main([*WORDS, "--messages", "ATTITUDE"])
    assert "GLOBAL_POSITION_SENSOR" in capsys.readouterr().err
