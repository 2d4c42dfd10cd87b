"""Text from outside is parsed in a time proportional to its length."""

from __future__ import annotations

import time

import pytest

from spn_data.errors import InputError
from spn_data.telemetry.csv_columns import parse_header
from spn_data.telemetry.srt_record import parse_record
from spn_model.training.recipe import read_recipe

MANY = 50_000
MOST_S = 2.0  # of processor time; a quadratic search takes far longer


@pytest.mark.parametrize(
    "cell",
    ["a(" + " " * MANY + "b", " " * MANY + "b", "(" * MANY, "a (b" * MANY, "[" * MANY + "]" * MANY],
)
def test_a_long_header_cell_takes_no_time(cell):
    """A header cell full of blanks and brackets is parsed in linear time."""
    start = time.process_time()
    assert list(parse_header([cell, "lat"])) == ["latitude"]
    assert time.process_time() - start < MOST_S


def test_the_last_brackets_of_a_cell_hold_its_unit():
    """The last brackets of a header cell hold its unit; others belong to the name and blanks are ignored."""
    columns = parse_header([" OSD.height above takeoff [ ft ] ", "lat( deg )", "lon (x) (deg)"])
    assert {name: [c.unit for c in found] for name, found in columns.items()} == {
        "rel_alt": ["ft"],
        "latitude": ["deg"],
    }


def test_a_long_number_takes_no_time():
    """A number of many digits that ends in a letter is refused at once."""
    start = time.process_time()
    with pytest.raises(ValueError, match=r"latitude is '111.*not a number"):
        parse_record(1, 0.0, "[latitude: " + "1" * MANY + "x]")
    assert time.process_time() - start < MOST_S


def test_a_long_blank_line_of_a_recipe_takes_no_time(tmp_path):
    """The line of a wrong key after a long line of blanks is found at once."""
    path = tmp_path / "r.toml"
    path.write_text(" " * MANY + "\nwrong = 1\nkind = 'regression'\n[[stages]]\n")
    start = time.process_time()
    with pytest.raises(InputError, match=r"r\.toml:2: unknown key 'wrong'"):
        read_recipe(str(path))
    assert time.process_time() - start < MOST_S
