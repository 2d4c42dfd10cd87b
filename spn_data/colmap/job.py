"""Parameters of one run of COLMAP's mapper."""

from __future__ import annotations

from dataclasses import dataclass

from spn_data.geometry.initial_lens import Hold


@dataclass(frozen=True, kw_only=True)
class MappingJob:
    """Parameters of one run of COLMAP's mapper over a database.

    Attributes
    ----------
    database : str
        Database file.
    images : str
        Image folder.
    output : str
        Existing folder, in which sub-models are written to model-0, model-1, ...
    snapshots : str
        Existing folder for snapshots.
    engine : str
        "incremental" or "global".
    threads : int
        Number of threads; -1 for all cores.
    seed : int
        Random seed.
    snapshot_every : int
        Number of registered images between snapshots.
    min_model_size : int
        Sub-models with fewer images are dropped.
    hold_intrinsics : bool
        Keep intrinsics fixed and leave their refinement to the final bundle adjustment.
    held : tuple of (int, Hold)
        Cameras whose focal length or lens is never changed, by COLMAP's id.
    start_from : str
        Folder of a model to continue from; empty to start from scratch.
    """

    database: str
    images: str
    output: str
    snapshots: str
    engine: str = "incremental"
    threads: int = -1
    seed: int = 0
    snapshot_every: int = 20
    min_model_size: int = 10
    hold_intrinsics: bool = False
    held: tuple[tuple[int, Hold], ...] = ()
    start_from: str = ""
