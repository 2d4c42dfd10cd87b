"""Tests of recipes: those of the package are valid, and errors name the line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from spn_data.errors import InputError
from spn_model.models.registry import make
from spn_model.training.recipe import Recipe, Stage, names, read_recipe

GOOD = """\
kind = "regression"
weights = "none"
optimizer = "sgd"
momentum = 0.8
options = { network = "squeezeposenet" }

[[stages]]
name = "first"
images = 300
batch = 4
rate = 1

[stages.options]
freeze_trunk = true

[[stages]]
data = "other/dataset.h5"
images = 900
schedule = "constant"
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text)
    return path


def test_a_recipe_is_read_whole(tmp_path):
    """All values are read, paths are relative to the recipe file, and missing values get defaults."""
    recipe = read_recipe(str(written(tmp_path, GOOD)))
    assert (recipe.kind, recipe.weights, recipe.optimizer) == ("regression", "none", "sgd")
    assert recipe.momentum == 0.8
    assert recipe.options == {"network": "squeezeposenet"}
    first, second = recipe.stages
    assert (first.name, first.images, first.batch, first.rate) == ("first", 300, 4, 1.0)
    assert first.options == {"freeze_trunk": True}
    assert first.data == "area"
    assert second == Stage(
        name="stage 2",
        data=str(tmp_path / "other/dataset.h5"),
        images=900,
        schedule="constant",
    )
    assert recipe.budget_shares == [0.25, 0.75]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('kind = "regression"', 'kin = "regression"', "kind is missing"),
        ('momentum = 0.8', "momentun = 0.8", ":4: unknown key 'momentun' of a recipe"),
        ("momentum = 0.8", "momentum = 1.0", ":4: momentum is 1.0, needs to be in"),
        ("momentum = 0.8", 'momentum = "0.8"', ":4: momentum is '0.8', needs to be a number"),
        ('"sgd"', '"adam"', ":3: optimizer is 'adam', needs to be one of adamw, sgd, muon"),
        ("batch = 4", "batch = 4.5", ":10: batch is 4.5, needs to be an integer"),
        ("batch = 4", "batch = true", ":10: batch is True, needs to be an integer"),
        ("batch = 4", "batch = 0", ":10: batch is 0, needs to be from 1 to"),
        ("batch = 4", "batch = 4\nparts = 3", ":11: parts is 3, needs to divide the batch size 4"),
        ("rate = 1", "rate = nan", ":11: rate is nan, needs to be from 0 to 100"),
        ("rate = 1", "speed = 1", ":11: unknown key 'speed' of a stage"),
        ('"constant"', '"linea"', ":19: schedule is 'linea', needs to be one of cosine, linear, constant"),
        ('"none"', "1", ":2: weights is 1, needs to be a string"),
        ("[stages.options]", "[stages.option]", ":13: unknown key 'option' of a stage"),
        ("images = 900", "minutes = 900", ":7: all stages need a budget, either all in images"),
        ("images = 900", "images = 0", ":7: all stages need a budget"),
        ("[[stages]]", "[stages]", "is not a valid recipe"),
        ("kind =", "kind", r"is not a valid recipe: .*line 1"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_its_line(tmp_path, old, new, told):
    """Unknown keys, wrong types, values out of range and invalid TOML are reported with file and line."""
    assert old in GOOD
    path = written(tmp_path, GOOD.replace(old, new))
    with pytest.raises(InputError, match=told) as caught:
        read_recipe(str(path))
    assert str(caught.value).startswith(str(path))


def test_what_is_no_recipe_is_refused(tmp_path):
    """An unknown name, a file without stages, a huge file and a binary file are rejected."""
    with pytest.raises(InputError, match=r"unknown recipe 'none'; .* default, paper"):
        read_recipe("none")
    with pytest.raises(InputError, match=r"a recipe needs 1 to 50 tables \[\[stages\]\]"):
        read_recipe(str(written(tmp_path, 'kind = "regression"\n')))
    with pytest.raises(InputError, match="is too large to be a recipe"):
        read_recipe(str(written(tmp_path, "#" * 200_000)))
    (tmp_path / "my.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="is not a valid recipe"):
        read_recipe(str(tmp_path / "my.toml"))


def test_the_recipes_of_the_package_can_be_made():
    """Every recipe of the package has valid options and a total budget of 30 minutes."""
    assert {"default", "paper", "vgg16", "posenet"} <= set(names())
    for name in names():
        recipe = read_recipe(name)
        if "vgg" not in name:  # 500 MB of random numbers
            assert make(recipe.kind, recipe.options).weights_name
        assert sum(stage.minutes for stage in recipe.stages) == pytest.approx(30)


def test_the_papers_recipe_is_the_papers():
    """The paper's recipe first trains added layers on pretraining data, then all; beta is 500 in both."""
    first, second = read_recipe("paper").stages
    assert (first.data, second.data) == ("pretraining", "area")
    assert first.options["freeze_trunk"]
    assert not second.options.get("freeze_trunk", False)
    assert first.options["beta"] == second.options["beta"] == 500
    assert first.options["loss"] == second.options["loss"] == "beta"


def test_another_budget_keeps_the_shares():
    """A new budget in images, minutes or both keeps the stages' shares; no budget changes nothing."""
    stages = (Stage(name="a", minutes=6, batch=16), Stage(name="b", minutes=24))
    recipe = Recipe(kind="regression", stages=stages)
    assert recipe.with_budget(None, None) == recipe
    assert [s.minutes for s in recipe.with_budget(None, 10).stages] == [2, 8]
    by_images = recipe.with_budget(1000, None)
    assert [(s.images, s.minutes) for s in by_images.stages] == [(200, 0), (800, 0)]
    both = recipe.with_budget(1000, 10).stages
    assert [(s.images, s.minutes) for s in both] == [(200, 2), (800, 8)]
    assert recipe.with_budget(3, None).stages[0].images == 16  # at least one step


def test_progress_is_of_whichever_budget_is_spent_first():
    """Progress is the larger of the shares of images and time used."""
    stage = Stage(name="a", images=1000, minutes=2)
    assert stage.progress(500, 10) == 0.5
    assert stage.progress(500, 90) == 0.75
    assert replace(stage, minutes=0.0).progress(500, 1e6) == 0.5


def test_the_rate_rises_and_falls():
    """The learning rate warms up linearly, then follows its cosine, constant or linear schedule."""
    stage = Stage(name="a", images=10_000, rate=0.4, warmup_steps=4)
    assert [stage.learning_rate_at(k, 0) for k in range(5)] == pytest.approx(
        [0.1, 0.2, 0.3, 0.4, 0.4]
    )
    assert stage.learning_rate_at(100, 0.5) == pytest.approx(0.2)
    assert stage.learning_rate_at(100, 1.0) == pytest.approx(0, abs=1e-12)
    assert replace(stage, schedule="constant").learning_rate_at(100, 0.9) == 0.4
    straight = replace(stage, schedule="linear")
    assert [straight.learning_rate_at(100, at) for at in (0, 0.25, 1.0, 1.1)] == pytest.approx(
        [0.4, 0.3, 0, 0]
    )


@pytest.mark.parametrize(
    ("images", "minutes", "drawn"),
    [(900, 0, 900), (0, 2, 24_000), (900, 2, 900), (50_000, 2, 24_000)],
)
def test_a_stage_knows_about_how_many_images_it_draws(images, minutes, drawn):
    """The expected number of images is the smaller of the image budget and 200 per second."""
    assert Stage(name="all", images=images, minutes=float(minutes)).expected_images == drawn
