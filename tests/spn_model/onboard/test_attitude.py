"""Attitude files on board: up in the camera from pitch and roll, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.errors import InputError
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from spn_model.autopilot.frames import Mounting
from spn_model.onboard.attitude import Attitude, GimbalMounting, read_attitude

MOUNTED = GimbalMounting(turn_deg=(1.5, 0.0, -0.5), sigma_deg=0.7, frames=50, flights=2)


def read(path, text: str, of: str = "camera", pitch_deg: float = 0.0, **given) -> Attitude:
    path.write_text(text)
    body = Mounting.pitched(pitch_deg).body_from_camera
    return read_attitude(path, of=of, body_from_camera=body, **{"mounting": None, **given})


def up_of(pitch_deg: float, roll_deg: float) -> np.ndarray:
    return rotations_from_angles(np.array([[70.0, pitch_deg, roll_deg]]))[0][:, 2]


def test_angles_of_camera_and_body_give_up(tmp_path):
    """Up is that of the pose; a camera that looks forward has the body's angles, a pitched one its sum."""
    path = tmp_path / "a.csv"
    text = "time_s,pitch_deg,roll_deg,sigma_deg\n0,-20,5,1\n"
    assert read(path, text).up[0] == pytest.approx(up_of(-20, 5))
    assert read(path, text, "body").up[0] == pytest.approx(up_of(-20, 5))
    level = "time_s,pitch_deg,roll_deg,sigma_deg\n0,-20,0,1\n"
    assert read(path, level, "body", -30.0).up[0] == pytest.approx(up_of(-50, 0))


def test_telemetry_of_a_gimbal_is_read_with_the_mounting_of_the_bundle(tmp_path):
    """The table that spn-data writes is read; its angles are turned, and get the measured deviation."""
    track = Telemetry.from_columns(
        np.arange(3.0), gimbal_deg=np.array([[10, -30, 1], [20, np.nan, 2], [30, -32, 1]])
    )
    write_track(tmp_path / "t.csv", track)
    body = Mounting.pitched(0.0).body_from_camera
    found = read_attitude(
        tmp_path / "t.csv", of="gimbal", mounting=MOUNTED, body_from_camera=body, offset_s=0.5
    )
    turn = rotations_from_vectors(np.deg2rad([MOUNTED.turn_deg]))[0]
    assert found.time_s.tolist() == [0.5, 2.5]
    assert found.up == pytest.approx(np.array([turn @ up_of(-30, 1), turn @ up_of(-32, 1)]))
    assert found.sigma_deg.tolist() == [0.7, 0.7]
    as_it_is = read_attitude(
        tmp_path / "t.csv", of="camera", mounting=MOUNTED, body_from_camera=body, sigma_deg=2.0
    )
    assert as_it_is.up[0] == pytest.approx(up_of(-30, 1))
    assert as_it_is.sigma_deg[0] == 2.0
    assert GimbalMounting.from_json(MOUNTED.to_json()) == MOUNTED


def test_spn_data_writes_the_file_from_telemetry(tmp_path):
    """`spn-data telemetry` writes what is read on board, from subtitles of a drone, and never over a file."""
    record = "00:00:00,{0}00 --> 00:00:00,{1}00\n[latitude: 49.0] [longitude: 8.4] [rel_alt: 5.0 "
    angles = "abs_alt: 120.0] [gb_yaw: 10.0 gb_pitch: -30.5 gb_roll: 1.5]"
    srt, table = tmp_path / "flight.SRT", tmp_path / "a.csv"
    srt.write_text("".join(f"{k + 1}\n{record.format(k, k + 1)}{angles}\n\n" for k in range(5)))
    words = ["telemetry", str(srt), "--to", str(table)]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    assert "5 with pitch and roll" in " ".join(done.output.split())
    body = Mounting.pitched(0.0).body_from_camera
    found = read_attitude(table, of="gimbal", mounting=MOUNTED, body_from_camera=body)
    assert found.time_s == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert found.up[3] @ up_of(-30.5, 1.5) == pytest.approx(np.cos(np.deg2rad(1.58)), abs=1e-4)
    assert CliRunner().invoke(main, words).exit_code == 1


def test_between_records_and_beyond_them(tmp_path):
    """Up is interpolated across a second, not across a longer gap, and never beyond the records."""
    text = "time_s,pitch_deg,roll_deg,sigma_deg\n1,-20,170,1\n2,-20,-170,3\n5,0,0,1\n"
    found = read(tmp_path / "a.csv", text)
    between = found.at(1.5)
    # Halfway between two rolls of almost 180 degrees is upside down, not level.
    assert np.array(between.up) @ up_of(-20, 180) > 0.999
    assert between.sigma_deg == 3.0
    assert found.at(2.0).up == pytest.approx(tuple(up_of(-20, -170)))
    assert [found.at(t) for t in (0.9, 2.5, 5.1, np.nan)] == [None] * 4
    assert "known for 2 of 9 images" in found.coverage(2, 9)
    assert "covers 1.0 to 5.0 s" in found.coverage(2, 9)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("time_s,pitch_deg\n", r"a.csv:1: its header needs the columns time_s, pitch_deg and roll"),
        ("", r"a.csv:1: its header needs"),
        ("time_s,pitch_deg,roll_deg\n0,1,2\n", "states no sigma_deg.*give --attitude-sigma"),
        ("time_s,pitch_deg,roll_deg\n0,,2\n", "has no record with pitch_deg and roll_deg"),
        ("time_s,pitch_deg,roll_deg\n0,1,2\n0,1,2\n", "a.csv:3: time_s '0' is not later"),
        ("time_s,pitch_deg,roll_deg\n0,nan,2\n", "a.csv:2: nan is outside"),
        ("time_s,pitch_deg,roll_deg\n0,1,200\n", "a.csv:2: 200.0 is outside -180 to 180"),
        ("time_s,pitch_deg,roll_deg\n0,1\n", "a.csv:2: 2 cells instead of 3"),
        ("time_s,pitch_deg,roll_deg,sigma_deg\n0,1,2,0\n", "a.csv:2: 0.0 is outside"),
        ("time_s,pitch_deg,roll_deg\n0,x,2\n", "a.csv:2: could not convert"),
    ],
)
def test_a_file_that_states_no_attitude_is_refused(tmp_path, rows, told):
    """Each fault of a file gives one line with its number."""
    with pytest.raises(InputError, match=told):
        read(tmp_path / "a.csv", rows)


@pytest.mark.parametrize("change", [{"turn_deg": [9, 9, 0]}, {"sigma_deg": 0}, {"frames": "x"}])
def test_a_mounting_out_of_bounds_is_damage(change):
    """A mounting in bundle.json is checked like every value from outside."""
    with pytest.raises((TypeError, ValueError)):
        GimbalMounting.from_json({**MOUNTED.to_json(), **change})
