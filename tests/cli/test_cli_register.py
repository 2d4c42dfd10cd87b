"""Options of `spn-data register`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.errors import InputError
from spn_data.pipeline import evaluation_stage


@pytest.mark.parametrize(("given", "expected"), [(("--time-offset", "-7200"), -7200.0), ((), None)])
def test_the_time_offset_reaches_the_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: tuple[str, ...], expected: float | None
) -> None:
    """`register --time-offset` is the option that messages about clocks name."""
    seen: list[float | None] = []

    def stop(_area: Any, _video: Any, _name: Any, options: Any, *_: Any, **__: Any) -> None:
        seen.append(options.time_offset_s)
        raise InputError("stopped by the test")

    monkeypatch.setattr(evaluation_stage, "register", stop)
    arguments = ["register", "a.mp4", "--area", str(tmp_path), "--threads", "1", *given]
    result = CliRunner().invoke(main, arguments)
    assert "stopped by the test" in str(result.exception) + result.stderr
    assert seen == [expected]
