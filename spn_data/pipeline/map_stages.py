"""From sources to a georeferenced model: the stages of an area in their order, and its extension."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from spn_data.area.area import Area
from spn_data.area.facts import Facts
from spn_data.area.names import FRAMES, GEO, GEO_FIT, MODEL, STAGES
from spn_data.errors import GeometryError, StageError
from spn_data.georegistration.result import GeoFit
from spn_data.pipeline.frames_stage import FramesOptions, Plan, choose_frames, plan
from spn_data.pipeline.geo_stage import (
    GeoStageOptions,
    georegister,
    has_fixes,
    recorded_options,
)
from spn_data.pipeline.model_stage import build_model
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.reconstruct import estimate_model_cost
from spn_data.storage.json_files import read_json
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.track import TelemetrySummary


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Of all stages."""

    frames: FramesOptions = field(default_factory=FramesOptions)
    model: ReconstructOptions = field(default_factory=ReconstructOptions)
    geo: GeoStageOptions | None = (
        None  # None: as the area was georegistered before, else the defaults
    )


class Watcher(Protocol):
    """Who looks on while the stages are made."""

    def progress(self, step: str, done: int, total: int) -> None: ...

    def planned(self, found: Plan, model_cost: tuple[float, int]) -> None: ...

    def telemetry(self, sequence: str, summary: TelemetrySummary | None) -> None: ...

    def stage(self, record: StageRecord) -> None: ...

    def unchanged(self, record: StageRecord) -> None: ...


def reconstruct(
    area: Area,
    inputs: list[Path],
    options: MapOptions,
    watcher: Watcher,
    *,
    overwrite: bool = False,
) -> None:
    """Frames, model and georegistration of the inputs. A stage made of the same is left as it is.

    Without telemetry there is no stage 3-geo. Raises StageError where telemetry does not determine the
    place in the world; the model stands then all the same.
    """
    found = plan(inputs, options.frames, tested=area)
    _stages(area, found, inputs, options, watcher, overwrite=overwrite, extended=None)


def add(
    area: Area,
    inputs: list[Path],
    options: MapOptions,
    watcher: Watcher,
    *,
    overwrite: bool = False,
) -> None:
    """Extend the area by the inputs; it stays as it is until its next version is complete.

    Frames, features and matches are taken over, the origin is kept, the map is made anew. Sources that the
    area holds already are passed over; InputError where there are no others. overwrite : starts anew where
    another addition is unfinished.
    """
    for stage in (FRAMES, MODEL):
        if not area.has(stage):
            raise StageError(f"{area.folder(stage)} is missing: nothing to add to; leave out --add")
    geo = _geo_options(area, options)
    if area.has(GEO):
        origin = GeoFit.from_json(read_json(area.folder(GEO) / GEO_FIT)).origin
        geo = replace(geo, fit=replace(geo.fit, origin=origin))
    options = replace(options, geo=geo)
    found = plan(inputs, options.frames, extended=area, tested=area)
    if overwrite:
        area.discard_next()
    following = area.next_area()
    _stages(following, found, inputs, options, watcher, overwrite=False, extended=area)
    area.replace_by_next()


def _stages(
    area: Area,
    found: Plan,
    inputs: list[Path],
    options: MapOptions,
    watcher: Watcher,
    *,
    overwrite: bool,
    extended: Area | None,
) -> None:
    def tell(record: StageRecord, before: StageRecord | None) -> None:
        (watcher.unchanged if record == before else watcher.stage)(record)

    watcher.planned(found, _model_cost(found, options.model))
    before = {stage: area.record(stage) for stage in STAGES if area.has(stage)}
    frames = choose_frames(
        area,
        found,
        options.frames,
        watcher.progress,
        extend=extended,
        overwrite=overwrite,
        tell=watcher.telemetry,
    )
    earlier = () if extended is None else extended.facts.sources
    lasting = area if extended is None else extended
    given = [lasting.stored_path(path) for path in inputs]
    area.write_facts(Facts(sources=(*earlier, *given), evaluation=lasting.facts.evaluation))
    tell(frames, before.get(FRAMES))
    model = build_model(area, options.model, watcher.progress, extend=extended, overwrite=overwrite)
    tell(model, before.get(MODEL))
    if not has_fixes(area):
        return
    try:
        geo_options = _geo_options(area, options)
        geo = georegister(area, geo_options, watcher.progress, overwrite=overwrite)
    except GeometryError as error:
        raise StageError(
            f"{area.folder(MODEL)} is complete, but its place in the world is refused: {error}"
        ) from error
    tell(geo, before.get(GEO))


def _geo_options(area: Area, options: MapOptions) -> GeoStageOptions:
    if options.geo is not None:
        return options.geo
    return recorded_options(area.record(GEO)) if area.has(GEO) else GeoStageOptions()


def _model_cost(found: Plan, options: ReconstructOptions) -> tuple[float, int]:
    """(seconds, bytes) that the model of the frames to choose is expected to take."""
    frames = max(1, found.cost.chosen)
    reduced = options.features.max_image_size_px**2 * 9 / 16 / 1e6
    megapixels = min(found.cost.chosen_megapixels / frames, reduced)
    return estimate_model_cost(frames, megapixels, options)
