"""Implementation of `spn-data reconstruct`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from spn_cli import options, page, remembered, show
from spn_data.capture.selection import SelectionOptions
from spn_data.matching.features import FeatureOptions
from spn_data.pipeline.frames_stage import FramesOptions
from spn_data.pipeline.geo_stage import GeoStageOptions
from spn_data.pipeline.map_stages import MapOptions, reconstruct
from spn_data.pipeline.map_stages import add as extend
from spn_data.reconstruction.attempts import ReconstructOptions


def run(
    inputs: tuple[Path, ...], area_folder: Path, *, add: bool, overwrite: bool, **chosen: Any
) -> None:
    """Make or extend the map of the area, and show each stage when it is done."""
    area = options.open_area(area_folder)
    with area.locked():
        wanted = _map_options(**remembered.fill(area, chosen))
        with show.Live() as live:
            if add:
                extend(area, list(inputs), wanted, live, overwrite=overwrite)
            else:
                reconstruct(area, list(inputs), wanted, live, overwrite=overwrite)
        remembered.keep(area, chosen, add=add)
        show.verdict(area)
        page.refresh(area)


def _map_options(
    *,
    fov_deg: tuple[tuple[str, float], ...],
    camera_files: tuple[tuple[str, str], ...],
    fixed_lens: bool,
    target_count: int | None,
    motion_share: float,
    mask: str | None,
    any_telemetry: bool,
    engine: str,
    max_features: int,
    max_image_size: int,
    threads: int | None,
    cluster: str,
    seed: int,
    **geo: Any,
) -> MapOptions:
    """Return the options of the mapping stages as given on the command line."""
    given = options.geo_options(**geo)
    return MapOptions(
        frames=FramesOptions(
            selection=SelectionOptions(target_count=target_count, motion_share=motion_share),
            fov_deg=dict(fov_deg),
            camera_files=dict(camera_files),
            fixed_lens=fixed_lens,
            mask=mask,
            any_telemetry=any_telemetry,
        ),
        model=ReconstructOptions(
            features=FeatureOptions(max_features=max_features, max_image_size_px=max_image_size),
            engine=engine,
            threads=threads or os.cpu_count() or 1,
            cluster=cluster,
            seed=seed,
        ),
        geo=None if given == GeoStageOptions() else given,
    )
