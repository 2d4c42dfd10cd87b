"""Results of an evaluation, as `spn-model evaluate` left them in a run's folder."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.names import CONFIG, ERRORS, METRICS
from spn_data.errors import FormatError, InputError
from spn_data.storage.json_files import DAMAGE, number_or, read_json
from spn_model.evaluation.metrics import AxisErrors, Spread, Summary, Within

_TEXT_COLUMNS = ("method", "group", "name", "stratum")


@dataclass(frozen=True, eq=False)
class RunResults:
    """Metrics of a trained network and of the baselines evaluated with it.

    Attributes
    ----------
    folder : Path
        Folder of the run.
    units : str
        "m", or "model" for a map without a known scale: the unit of all positions.
    config : mapping
        config.json: options of the training, data set, versions, facts.
    groups : mapping of str to mapping of str to Summary
        By group of the data set, then by method; a run's own method has the name of the run. A median or
        95th percentile is infinite if too few frames have a pose.
    """

    folder: Path
    units: str
    config: Mapping[str, Any]
    groups: Mapping[str, Mapping[str, Summary]]

    @property
    def name(self) -> str:
        """Name of the run, and of its method in `groups`."""
        return self.folder.name

    @cached_property
    def errors(self) -> dict[str, np.ndarray]:
        """Columns of errors.csv: one row per frame and method; NaN for an empty number.

        Raises FormatError if the file is damaged, InputError if it is missing.
        """
        path = self.folder / ERRORS
        if not path.is_file():
            raise InputError("does not exist; run spn-model evaluate first", path=path)
        try:
            with path.open(encoding="utf-8", newline="") as file:
                rows = list(csv.DictReader(file))
            if not rows:
                raise ValueError("it has no rows")
            return {column: _column([row[column] for row in rows], column) for column in rows[0]}
        except (OSError, csv.Error, KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path}: cannot be read ({error})") from error


def read_run(folder: str | PathLike[str]) -> RunResults:
    """Read what training and evaluation left in a run's folder.

    Parameters
    ----------
    folder : str or path-like
        ``runs/<name>`` of an area.

    Returns
    -------
    RunResults

    Raises
    ------
    InputError
        If the folder holds no evaluated run.
    FormatError
        If a file is damaged or was written by a newer version.
    """
    folder = Path(folder)
    path = folder / METRICS
    if not path.is_file():
        raise InputError("does not exist; run spn-model evaluate first", path=path)
    document = read_json(path)
    try:
        groups = {
            str(group): {str(method): _summary(value) for method, value in methods.items()}
            for group, methods in document["groups"].items()
        }
        return RunResults(folder, str(document["units"]), read_json(folder / CONFIG), groups)
    except DAMAGE as error:
        raise FormatError(f"{path}: cannot be read ({error!r})") from error


def _summary(value: Mapping[str, Any]) -> Summary:
    return Summary(
        frames=int(value["frames"]),
        located=int(value["located"]),
        position=_spread(value["position"]),
        rotation_deg=_spread(value["rotation_deg"]),
        within=tuple(
            Within(float(w["limit"]), float(w["limit_deg"]), float(w["share"]))
            for w in value["within"]
        ),
        axes=tuple(
            AxisErrors(
                str(axis["axis"]),
                number_or(axis["signed_median"], math.nan),
                number_or(axis["signed_mean"], math.nan),
                number_or(axis["absolute_median"], math.inf),
                number_or(axis["absolute_p95"], math.inf),
            )
            for axis in value["axes"]
        ),
    )


def _spread(value: Mapping[str, Any]) -> Spread:
    return Spread(
        median=number_or(value["median"], math.inf),
        mean=number_or(value["mean"], math.nan),
        p95=number_or(value["p95"], math.inf),
    )


def _column(cells: list[str], name: str) -> np.ndarray:
    if name in _TEXT_COLUMNS:
        return np.array(cells, dtype=np.str_)
    return np.array([float(cell) if cell else math.nan for cell in cells])
