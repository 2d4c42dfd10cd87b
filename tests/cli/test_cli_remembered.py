"""Options that an area remembers: each comes back as it was typed, and added flights have their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from spn_cli import options, remembered

from spn_data.area.area import Area


def typed(root: Path, *words: object) -> tuple[dict[str, Any], Result]:
    """Run a command that takes all remembered options; return what it had to work with."""
    had: dict[str, Any] = {}

    @click.command()
    @click.option("--add", is_flag=True)
    @options.fov
    @options.georegistration
    def command(add: bool, **chosen: Any) -> None:
        area = Area(root)
        had.update(remembered.fill(area, chosen))
        remembered.keep(area, chosen, add=add)

    result = CliRunner().invoke(command, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return had, result


def test_every_option_comes_back_as_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numbers, pairs, options by sequence, files and flags are taken by a later command in another folder."""
    root = tmp_path / "area"
    root.mkdir()
    (tmp_path / "points.csv").write_text("")
    monkeypatch.chdir(tmp_path)
    given, _ = typed(
        *(root, "--fov", "72", "--fov", "flight2=94.5", "--gnss-sigma", "0.03", "0.05"),
        *(
            "--gnss-bias",
            "1,2",
            "--gcp",
            "points.csv",
            "--check-points",
            "a,b",
            "--gcp-sigma",
            "1",
            "2",
        ),
        *("--mark-sigma", "0.5", "--time-offset", "flight2=-0.1", "--heights", "absolute"),
        *("--height-reference", "amsl", "--takeoff-alt", "115.3", "--correlation-time", "7"),
        "--ignore-gimbal",
    )
    assert len(Area(root).facts.options) == len(options.REMEMBERED)
    monkeypatch.chdir(root)
    again, result = typed(root)
    assert again.pop("gcp_file").samefile(tmp_path / given.pop("gcp_file"))
    assert again == given
    assert result.output.count("Note: taken as given before") == 1


def test_another_field_of_view_is_of_the_added_flights(tmp_path: Path) -> None:
    """With --add it is said and not remembered; without, it replaces the former, which is said too."""
    typed(tmp_path, "--fov", "72")
    had, result = typed(tmp_path, "--add", "--fov", "94")
    assert had["fov_deg"] == (("*", 94.0),)
    said = " ".join(result.output.split())
    assert "--fov 94.0 is of the added flights; the others keep 72.0" in said
    assert Area(tmp_path).facts.options == {"fov": ("72.0",)}
    _, result = typed(tmp_path, "--fov", "94")
    assert "--fov 94.0 replaces 72.0" in " ".join(result.output.split())
    assert Area(tmp_path).facts.options == {"fov": ("94.0",)}
