"""Files of a trained network in an area."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from spn_data.area import names
from spn_data.errors import StageError


@dataclass(frozen=True)
class RunFiles:
    """Folder of one run and the paths of the files in it, which need not exist.

    Attributes
    ----------
    folder : Path
        Folder of the run, as returned by `Area.run_folder`.
    """

    folder: Path

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.folder.name

    @property
    def checkpoint(self) -> Path:
        """Best network by validation."""
        return self.folder / names.CHECKPOINT

    @property
    def last(self) -> Path:
        """Network at the end of the training."""
        return self.folder / names.LAST

    @property
    def state(self) -> Path:
        """State that an unfinished training resumes from."""
        return self.folder / names.STATE

    @property
    def log(self) -> Path:
        """Log of the training, a CSV file."""
        return self.folder / names.LOG

    @property
    def config(self) -> Path:
        """Options, inputs and facts of the training."""
        return self.folder / names.CONFIG

    @property
    def metrics(self) -> Path:
        """Metrics of the last evaluation."""
        return self.folder / names.METRICS

    @property
    def errors(self) -> Path:
        """Errors of each frame in the last evaluation, a CSV file."""
        return self.folder / names.ERRORS

    @property
    def fixes(self) -> Path:
        """Fix of each image in the last evaluation, a CSV file."""
        return self.folder / names.FIXES

    @property
    def expected(self) -> Path:
        """What is expected of the last plan with the bundle."""
        return self.folder / names.EXPECTED

    @property
    def figures(self) -> Path:
        """Folder of the figures of the last evaluation."""
        return self.folder / names.FIGURES

    @property
    def bundle(self) -> Path:
        """Folder of the exported bundle."""
        return self.folder / names.BUNDLE

    def require_checkpoint(self) -> Path:
        """Return the path of the checkpoint; raise StageError if there is none."""
        if not self.checkpoint.is_file():
            raise StageError(
                f"{self.folder} holds no trained network; run spn-model train --run {self.name} first"
            )
        return self.checkpoint
