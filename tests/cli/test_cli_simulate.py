"""`spn-data simulate`: what it writes, and the command that follows."""

from __future__ import annotations

import json
import shlex

import pytest
from click.testing import CliRunner
from spn_cli.data import main


@pytest.mark.slow
def test_simulate_names_the_command_that_reconstructs_its_flights(tmp_path):
    """The next step has the mapping folder, an area beside the output, and the field of view."""
    out = tmp_path / "flights"
    words = ["simulate", str(out), "--only", "flight1", "--length-factor", "0.02", "--json"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    command = json.loads(result.stdout)["next"]["command"]
    found = main.commands["reconstruct"].make_context("reconstruct", shlex.split(command)[2:])
    assert list(found.params["inputs"]) == [out / "mapping"]
    assert (out / "mapping" / "flight1.mp4").is_file()
    assert found.params["area_folder"] == tmp_path / "flights-area"
    assert found.params["fov_deg"] == (("*", 72.0),)
