"""Parameter files: each line is explained, and one position is fused."""

from __future__ import annotations

import re

import pytest

from spn_data.errors import InputError
from spn_model.autopilot.parameters import parameter_file, parameters
from spn_model.autopilot.profiles import Message


def values(profile, **options):
    """Return the values of a profile's parameters by name."""
    return {p.name: p.value for p in parameters(profile, **options)}


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
@pytest.mark.parametrize("use_height", [False, True])
def test_every_line_has_its_reason(profile, use_height):
    """Above each parameter is a comment, and each is in the file once, in the autopilot's format."""
    text = parameter_file(profile, use_height=use_height, delay_ms=40.0)
    lines = text.splitlines()
    assert lines[0].startswith("# Parameters of")
    form = r"1\t1\t[A-Z0-9_]+\t[-0-9.]+\t[69]" if profile == "px4" else r"[A-Z0-9_]+,[-0-9.]+"
    for reason, line in zip(lines[1::2], lines[2::2], strict=True):
        assert re.fullmatch(r"# [A-Z].+\.", reason)
        assert re.fullmatch(form, line), line
    names = re.findall(r"[A-Z][A-Z0-9]+_[A-Z0-9_]+(?=[\t,])", text)
    assert sorted(names) == sorted(values(profile, use_height=use_height))
    assert len(names) == len(set(names))


def test_px4_fuses_the_position_once():
    """Either the auxiliary global position or external vision gives the position, never both."""
    both = values("px4")
    assert (both["EKF2_AGP0_CTRL"], both["EKF2_EV_CTRL"] & 1, both["EKF2_EV_CTRL"] & 8) == (1, 0, 8)
    local = values("px4", messages=(Message.ODOMETRY,), use_height=True)
    assert (local["EKF2_AGP0_CTRL"], local["EKF2_EV_CTRL"]) == (0, 1 + 2 + 8)


def test_ardupilot_takes_position_and_yaw_but_no_velocity():
    """VISO_TYPE is 1, since 3 moves the map, and a velocity is not waited for."""
    found = values("ardupilot", delay_ms=61.6)
    assert (found["VISO_TYPE"], found["VISO_DELAY_MS"], found["VISO_QUAL_MIN"]) == (1, 62, 1)
    assert [found[f"EK3_SRC1_{n}"] for n in ("POSXY", "VELXY", "POSZ", "VELZ", "YAW")] == [
        6,
        0,
        1,
        0,
        6,
    ]
    assert values("ardupilot", use_height=True)["EK3_SRC1_POSZ"] == 6


def test_a_message_without_quality_needs_another_threshold():
    """VISION_POSITION_ESTIMATE has the quality 0, which a threshold of 1 would drop."""
    messages = (Message.VISION_POSITION_ESTIMATE,)
    assert values("px4", messages=messages)["EKF2_EV_QMIN"] == 0
    assert values("ardupilot", messages=messages)["VISO_QUAL_MIN"] == 0


def test_the_file_of_ros_is_yaml_with_fifteen_choices():
    """robot_localization gets x, y, z and yaw of the topic that is written."""
    text = parameter_file("ros2")
    assert "pose0: /spn/pose" in text
    chosen = re.findall("true|false", text.split("pose0_config: [")[1].split("]")[0])
    assert [i for i, word in enumerate(chosen) if word == "true"] == [0, 1, 2, 5]
    assert len(chosen) == 15


@pytest.mark.parametrize("delay_ms", [-1.0, 251.0, float("nan")])
def test_delays_out_of_range_are_refused(delay_ms):
    """ArduPilot corrects at most 250 ms."""
    with pytest.raises(InputError, match="the delay is"):
        parameters("ardupilot", delay_ms=delay_ms)
