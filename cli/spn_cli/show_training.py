"""Display of a training: a live table on a terminal, otherwise a line from time to time."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from spn_cli import console, output

if TYPE_CHECKING:
    from spn_model.training.recipe import Recipe

_PLAIN_EVERY_S = 60.0
_SHOWN = 12  # rows of the live table
_NAMES = {
    "validation": "validation",
    "held out": "validation, before training on it",
    "views": "held-out rendered views",
    "training": "training images",
}


class TrainingDisplay:
    """Display of log rows, which requests a stop after Ctrl-C; see `spn_model.runs.run_training.RunWatch`.

    Only the first process of a training displays anything.
    """

    def __init__(self, recipe: Recipe):
        from spn_model.training.machine import is_main_process

        self._stages = {stage.name: k for k, stage in enumerate(recipe.stages)}
        self._shares = recipe.budget_shares
        self._unit, self._shows = "m", is_main_process()
        self._stop = self._has_begun = False
        self._validated: list[tuple[str, ...]] = []
        self._status = "Preparing the training images."
        self._printed = -_PLAIN_EVERY_S
        live = self._shows and console.err.is_terminal and not output.current().quiet
        self._live = Live(console=console.err, refresh_per_second=4) if live else None

    @contextmanager
    def training(self, unit: str, *, resumes: bool) -> Iterator[None]:
        """Show the training within the block, and let Ctrl-C request a stop."""
        self._unit = unit
        with _stop_signals(self.stop), self._live_table():
            if self._live is None:
                self.say(self._status)
            if resumes:
                self.say("Resuming the interrupted training.")
            yield

    @contextmanager
    def _live_table(self) -> Iterator[None]:
        if self._live is None:
            yield
            return
        output.current().has_shown = True
        self._live.start()
        self._live.update(self._table())
        try:
            yield
        finally:
            self._status = ""
            self._live.update(self._table())
            self._live.stop()

    def stop(self) -> None:
        """Request a stop after the current step; before the first step there is nothing to save."""
        self._stop = True
        if not self._has_begun:
            raise KeyboardInterrupt
        self.say("Stopping after this step.")

    def wants_stop(self) -> bool:
        """Return whether a stop was requested; from the first call on, a stop waits for the step."""
        self._has_begun = True
        return self._stop

    def is_stopping(self) -> bool:
        """Return whether a stop was requested."""
        return self._stop

    def say(self, text: str) -> None:
        """Print a line."""
        if self._shows:
            console.step(text)

    def row(self, values: Mapping[str, Any]) -> None:
        """Show a row of the log, see `spn_model.training.training_record.Watch`."""
        if values["event"] == "steps":
            self._status = self._steps(values)
            now = time.monotonic()
            if self._live is None and self._shows and now - self._printed > _PLAIN_EVERY_S:
                self._printed = now
                self.say(self._status)
        else:
            cells = (
                f"{self._done(values):.0%}",
                _NAMES[values["event"]],
                *_errors(values),
            )
            self._validated.append(cells)
            if self._live is None and self._shows:
                done, what, m, deg, m95, deg95, poses = cells
                self.say(
                    f"{done} {what}: median {m} {self._unit}, {deg}°; 95 % within {m95} {self._unit}, "
                    f"{deg95}°; {poses} have a pose"
                )
        if self._live is not None:
            self._live.update(self._table())

    def _steps(self, values: Mapping[str, Any]) -> str:
        done, train_s = self._done(values), values["train_s"]
        left_s = train_s / done * (1 - done) if done > 0 else 0.0
        left = f", about {console.duration(left_s)} left" if left_s > 1 else ""
        return (
            f"{done:.0%} {values['stage']}: {values['images']:,} images, "
            f"{values['images_per_s']:.1f} per second, loss {values['loss']:.4g}"
            f" {values['figures']}{left}"
        )

    def _done(self, values: Mapping[str, Any]) -> float:
        index = self._stages[values["stage"]]
        return sum(self._shares[:index]) + self._shares[index] * float(values["progress"])

    def _table(self) -> Group:
        table = Table(box=None)
        for title in ("", "", f"median {self._unit}", "°", f"95 % {self._unit}", "°", "poses"):
            table.add_column(title, justify="right")
        for cells in self._validated[-_SHOWN:]:
            table.add_row(*(Text(cell) for cell in cells))
        return Group(table, Text(self._status))


def errors_table(facts: Mapping[str, Any], unit: str) -> None:
    """Print errors of the kept checkpoint and of the last network, and the time of the training."""
    output.figures(units=unit, training=facts)
    rows = []
    for title, found in (("kept", facts["kept"]), ("at the end", facts["latest"])):
        for event, name in _NAMES.items():
            if found and found.get(event):
                rows.append((f"{name}, {title}", *_errors(found[event])))
    header = ("", f"median {unit}", "°", f"95 % {unit}", "°", "poses")
    console.table("Errors", rows, header)
    console.say(
        f"Trained for {console.duration(facts['train_s'])} "
        f"({facts['images_shown']:,} images, {facts['precision']}, {facts['threads']} threads, "
        f"{facts['device']}), plus {console.duration(facts['validate_s'])} of validation."
    )


def _errors(values: Mapping[str, Any]) -> tuple[str, ...]:
    figures = [
        "none" if values[name] is None else f"{values[name]:.{digits}f}"
        for name, digits in (("median_m", 2), ("median_deg", 1), ("p95_m", 2), ("p95_deg", 1))
    ]
    return (*figures, f"{values['located']} of {values['frames']}")


@contextmanager
def _stop_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C within the block; a second Ctrl-C interrupts at once.

    SIGTERM arrives as Ctrl-C too, see `spn_cli.console`.
    """

    def handle(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        stop()

    before: Any = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
