"""Records of intermediate models, by which an interrupted reconstruction continues."""

from __future__ import annotations

import pytest

from spn_data.errors import FormatError
from spn_data.reconstruction.saved_models import (
    read_settled,
    read_submodels,
    write_settled,
    write_submodels,
)


@pytest.fixture
def mapping(tmp_path):
    """Return the folder of a mapping with two sub-models."""
    for name in ("model-0", "model-1"):
        (tmp_path / "mapping-first" / "models" / name).mkdir(parents=True)
    return tmp_path / "mapping-first"


def test_models_are_read_as_written(mapping):
    """Both records name the folders that were written, and none exists before."""
    models = [mapping / "models" / name for name in ("model-1", "model-0")]
    assert read_submodels(mapping) is None
    assert read_settled(mapping, mapping.parent) is None
    write_submodels(mapping, models)
    write_settled(mapping, mapping.parent, models[0], ["one note"])
    assert read_submodels(mapping) == models
    assert read_settled(mapping, mapping.parent) == (models[0], ["one note"])


@pytest.mark.parametrize(
    "text",
    ['["../../models/model-0"]', '["/tmp"]', "[1]", '{"a": 1}', '["none"]', "[" * 5000, '[""]'],
)
def test_a_damaged_list_of_models_is_one_line(mapping, text):
    """A list that leads out of the mapping, or is none, is reported with its file."""
    (mapping / "models.json").write_text(text)
    with pytest.raises(FormatError, match=r"models\.json: is not a list of models"):
        read_submodels(mapping)


@pytest.mark.parametrize(
    "text",
    [
        '{"model": "..", "notes": []}',
        '{"model": "mapping-first", "notes": [1]}',
        '{"model": "mapping-first", "notes": "a note"}',
        '{"model": "mapping-first"}',
        '{"notes": []}',
    ],
)
def test_a_damaged_record_of_a_model_is_one_line(mapping, text):
    """A record that leads out of the working folder, or has notes of another kind, is reported."""
    (mapping / "settled.json").write_text(text)
    with pytest.raises(FormatError, match=r"settled\.json: is not a record of a model"):
        read_settled(mapping, mapping.parent)


def test_a_record_of_an_earlier_version_is_read(mapping):
    """A reconstruction that an earlier version began goes on: its key of the notes is known."""
    (mapping / "settled.json").write_text('{"model": "mapping-first", "told": ["a note"]}')
    assert read_settled(mapping, mapping.parent) == (mapping.parent / "mapping-first", ["a note"])
