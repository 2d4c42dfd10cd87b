"""Training recipes: TOML files with the kind of network, its options and one or more training stages."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from spn_data.errors import InputError

SHIPPED = Path(__file__).parent / "recipes"
AREA, PRETRAINING = "area", "pretraining"  # data sets that a stage can name instead of a path
TRAINING, ALL = "training", "all"  # frames of the mapping flights that a stage trains on
OPTIMIZERS = ("adamw", "sgd", "muon")
SCHEDULES = ("cosine", "linear", "constant")
_MAX_BYTES = 100_000
_IMAGES_PER_S = 200  # speed of the default network on two cores
_MAX_INTEGER = 2**63 - 1  # TOML promises no more
_MAX_STAGES = 50
_RANGES: dict[str, tuple[float, float]] = {
    "images": (0, 10**10),
    "minutes": (0, 10**6),
    "batch": (1, 100_000),
    "parts": (1, 64),
    "rate": (0, 100),
    "warmup_steps": (0, 10**7),
    "weight_decay": (0, 10),
    "clip": (0, 10**9),
}


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Training stage, which ends when its budget of images or of minutes is used up, whichever is first."""

    name: str
    data: str = AREA  # area, pretraining (--pretrain, or area without it), or a path
    frames: str = TRAINING  # training, or all: also validation frames, which then validate no more
    images: int = 0  # budget of training images drawn; 0: no limit
    minutes: float = 0.0  # budget of training time without validation; 0: no limit
    batch: int = 8  # batch size of each process
    parts: int = 1  # parts of a batch computed in parallel; their losses have equal weights
    rate: float = 1e-3  # peak learning rate
    schedule: str = "cosine"  # learning rate schedule: cosine to 0, linear to 0, or constant
    warmup_steps: int = 50  # steps of linear learning rate warm-up
    weight_decay: float = 1e-4
    clip: float = 0.0  # gradient clipping: largest norm; 0: no limit
    options: Mapping[str, Any] = field(default_factory=dict)  # options of the pose model

    @property
    def expected_images(self) -> int:
        """Expected number of training images drawn: the budget, or what two cores process in its minutes."""
        by_minutes = round(self.minutes * 60 * _IMAGES_PER_S)
        return min((n for n in (self.images, by_minutes) if n), default=0)

    def progress(self, drawn: int, seconds: float) -> float:
        """Return the fraction of the budget that is used; the stage is done at 1."""
        by_images = drawn / self.images if self.images else 0.0
        return max(by_images, seconds / 60 / self.minutes if self.minutes else 0.0)

    def learning_rate_at(self, step: int, progress: float) -> float:
        """Return the learning rate of a step (from 0) after the fraction `progress` of the budget."""
        rate = self.rate * min(1.0, (step + 1) / max(self.warmup_steps, 1))
        if self.schedule == "cosine":
            rate *= 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
        elif self.schedule == "linear":
            rate *= max(0.0, 1 - progress)
        return rate


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Kind of network with its options, initial weights and stages.

    Attributes
    ----------
    kind : str
        A kind of `spn_model.models.registry`.
    stages : tuple of Stage
        Stages in order.
    options : mapping
        Options of the pose model.
    weights : str
        Initial weights: "published" for the network's default ones, "none", a name of
        `spn_model.pretrained.weights`, or a file.
    optimizer : str
        "adamw", "sgd" or "muon".
    momentum : float
        Momentum of sgd.
    """

    kind: str
    stages: tuple[Stage, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    weights: str = "published"
    optimizer: str = "adamw"
    momentum: float = 0.9

    def plain(self) -> dict[str, Any]:
        """Return the recipe as plain values for JSON, including all defaults."""
        return {**asdict(self), "stages": [asdict(stage) for stage in self.stages]}

    @property
    def budget_shares(self) -> list[float]:
        """Fraction of the total budget of each stage."""
        by = [float(stage.images) for stage in self.stages]
        if not all(by):
            by = [stage.minutes for stage in self.stages]
        return [part / sum(by) for part in by]

    def with_budget(self, images: int | None, minutes: float | None) -> Recipe:
        """Return the recipe with another total budget, divided among the stages in the same proportions."""
        if images is None and minutes is None:
            return self
        return replace(
            self,
            stages=tuple(
                replace(
                    stage,
                    images=0 if images is None else max(stage.batch, round(images * share)),
                    minutes=0.0 if minutes is None else minutes * share,
                )
                for stage, share in zip(self.stages, self.budget_shares, strict=True)
            ),
        )


def names() -> tuple[str, ...]:
    """Return the names of the shipped recipes."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def read_recipe(name_or_file: str) -> Recipe:
    """Read a recipe.

    Parameters
    ----------
    name_or_file : str
        Name of a shipped recipe, or path of a TOML file.

    Returns
    -------
    Recipe

    Raises
    ------
    InputError
        If the recipe does not exist or is wrong, with the line.
    """
    path = SHIPPED / f"{name_or_file}.toml" if name_or_file in names() else Path(name_or_file)
    if not path.is_file():
        raise InputError(
            f"unknown recipe {name_or_file!r}; give a file or one of {', '.join(names())}"
        )
    if path.stat().st_size > _MAX_BYTES:
        raise InputError("is too large to be a recipe", path=path)
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except RecursionError as error:
        raise InputError("is not a valid recipe: nested too deeply", path=path) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"is not a valid recipe: {error}", path=path) from error
    return _Reader(path, text).recipe(table)


class _Reader:
    """Checks the values of one recipe file and finds the line of a key."""

    def __init__(self, path: Path, text: str):
        self._path, self._lines = path, text.splitlines()

    def recipe(self, table: dict[str, Any]) -> Recipe:
        """Return the recipe of a parsed file. Raises InputError, with the line, if a value is wrong."""
        stages = table.pop("stages", [])
        if not isinstance(stages, list) or not 0 < len(stages) <= _MAX_STAGES:
            raise self._wrong("stages", f"a recipe needs 1 to {_MAX_STAGES} tables [[stages]]")
        if "kind" not in table:
            raise self._wrong("kind", 'kind is missing; add for example kind = "regression"')
        defaults = {"kind": "", "options": {}, "weights": "", "optimizer": "", "momentum": 0.0}
        values = self._values(table, defaults, "a recipe")
        if values.get("optimizer", "adamw") not in OPTIMIZERS:
            raise self._wrong(
                "optimizer",
                f"optimizer is {values['optimizer']!r}, needs to be one of {', '.join(OPTIMIZERS)}",
            )
        if not 0 <= values.get("momentum", 0.9) < 1:
            raise self._wrong(
                "momentum", f"momentum is {values['momentum']}, needs to be in [0, 1)"
            )
        made = tuple(self._stage(stage, k) for k, stage in enumerate(stages))
        if len({stage.name for stage in made}) != len(made):
            raise self._wrong("name", "two stages have the same name")
        if not (all(s.images for s in made) or all(s.minutes for s in made)):
            raise self._wrong(
                "stages", "all stages need a budget, either all in images or all in minutes"
            )
        return Recipe(stages=made, **values)

    def _stage(self, table: Any, k: int) -> Stage:
        if not isinstance(table, dict):
            raise self._wrong("stages", "stages need to be tables [[stages]]")
        defaults = {f.name: f.default for f in Stage.__dataclass_fields__.values()}
        defaults |= {"name": "", "options": {}}
        values = self._values({"name": f"stage {k + 1}", **table}, defaults, "a stage", k)
        if values.get("schedule", "cosine") not in SCHEDULES:
            text = f"schedule is {values['schedule']!r}, needs to be one of {', '.join(SCHEDULES)}"
            raise self._wrong("schedule", text, k)
        if values.get("frames", TRAINING) not in (TRAINING, ALL):
            text = f"frames is {values['frames']!r}, needs to be {TRAINING} or {ALL}"
            raise self._wrong("frames", text, k)
        for name, (low, high) in _RANGES.items():
            if name in values and not low <= values[name] <= high:
                text = f"{name} is {values[name]}, needs to be from {low:g} to {high:g}"
                raise self._wrong(name, text, k)
        batch, parts = values.get("batch", Stage.batch), values.get("parts", Stage.parts)
        if batch % parts:
            raise self._wrong(
                "parts", f"parts is {parts}, needs to divide the batch size {batch}", k
            )
        data = values.get("data", AREA)
        if data not in (AREA, PRETRAINING) and not Path(data).is_absolute():
            values["data"] = str(self._path.parent / data)
        return Stage(**values)

    def _values(
        self, table: dict[str, Any], defaults: dict[str, Any], of: str, stage: int = -1
    ) -> dict[str, Any]:
        values = {}
        for name, value in table.items():
            if name not in defaults:
                text = f"unknown key {name!r} of {of}; keys are {', '.join(defaults)}"
                raise self._wrong(name, text, stage)
            wanted = type(defaults[name])
            if type(value) is int and abs(value) > _MAX_INTEGER:
                raise self._wrong(name, f"{name} is too large a number", stage)
            if wanted is float and type(value) is int:
                value = float(value)
            if type(value) is not wanted:
                needed = {dict: "a table", str: "a string", int: "an integer"}
                text = f"{name} is {value!r}, needs to be {needed.get(wanted, 'a number')}"
                raise self._wrong(name, text, stage)
            values[name] = value
        return values

    def _wrong(self, key: str, message: str, stage: int = -1) -> InputError:
        """Return the error with the line of a key: the first match after the start of its stage."""
        begins = [n for n, text in enumerate(self._lines) if re.match(r"\s*\[\[\s*stages", text)]
        first = begins[stage] if 0 <= stage < len(begins) else 0
        for n, text in enumerate(self._lines[first:], first + 1):
            if re.match(rf"""\s*(?:\[+\s*)?(\w+\.)?["']?{re.escape(key)}["']?\s*(=|\.|\])""", text):
                return InputError(message, path=self._path, line=n)
        return InputError(message, path=self._path)
