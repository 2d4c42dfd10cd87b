"""What one run of COLMAP's mapper is given."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class MappingJob:
    """One run of COLMAP's mapper over a database."""

    database: str
    images: str  # folder
    output: str  # an existing folder; sub-models are written to model-0, model-1, ... in it
    snapshots: str  # an existing folder
    engine: str = "incremental"  # or "global"
    threads: int = -1
    seed: int = 0
    snapshot_every: int = 20  # registered images
    min_model_size: int = 10  # images, below which a sub-model is dropped
    hold_intrinsics: bool = False  # leave their refinement to the last bundle adjustment
    start_from: str = ""  # folder of a model to go on from
