"""Mapping of an area: frames, model and georegistration, and its extension by new sources."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from spn_data.area.area import Area
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
from spn_data.storage.json_files import read_json, reporting_damage
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.track import TelemetrySummary


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Options of all mapping stages.

    Attributes
    ----------
    frames : FramesOptions
    model : ReconstructOptions
    geo : GeoStageOptions or None
        None: as the area was georegistered before, or the defaults.
    """

    frames: FramesOptions = field(default_factory=FramesOptions)
    model: ReconstructOptions = field(default_factory=ReconstructOptions)
    geo: GeoStageOptions | None = None


class Watcher(Protocol):
    """Observer of the mapping stages."""

    def progress(self, step: str, done: int, total: int) -> None:
        """Report that `done` of `total` units of a step are done."""

    def planned(self, found: Plan, model_cost: tuple[float, int]) -> None:
        """Report sources and expected cost (seconds, bytes) of the model, before any work."""

    def telemetry(self, sequence: str, summary: TelemetrySummary | None) -> None:
        """Report the telemetry of a sequence; None if it has none."""

    def stage(self, record: StageRecord) -> None:
        """Report that a stage is complete."""

    def unchanged(self, record: StageRecord) -> None:
        """Report that a stage was up to date."""


def reconstruct(
    area: Area,
    inputs: list[Path],
    options: MapOptions,
    watcher: Watcher,
    *,
    overwrite: bool = False,
) -> None:
    """Choose frames, reconstruct the model and georegister it.

    A stage with the same inputs and options is left unchanged. Without telemetry there is no stage 3-geo.

    Parameters
    ----------
    area : Area
    inputs : list of Path
        Videos, or folders with videos or photos.
    options : MapOptions
    watcher : Watcher
    overwrite : bool
        Whether stages with other inputs or options may be replaced.

    Raises
    ------
    StageError
        If the reconstruction fails, or the telemetry does not determine the georegistration; the model is
        then complete.
    InputError
        If an input cannot be used.
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
    """Extend an area by further sources; it does not change until its next version is complete.

    Frames, features and matches are reused and the origin is kept, but the map is reconstructed again.
    Sources that are already in the area are skipped; without others, the area is unchanged.

    Parameters
    ----------
    area : Area
    inputs : list of Path
    options : MapOptions
    watcher : Watcher
    overwrite : bool
        Whether to discard another, unfinished extension.

    Raises
    ------
    StageError
        If the area has no model, or as in `reconstruct`.
    InputError
        If an input cannot be used.
    """
    for stage in (FRAMES, MODEL):
        if not area.has(stage):
            raise StageError(f"{area.folder(stage)} is missing: nothing to add to; leave out --add")
    geo = _geo_options(area, options)
    if area.has(GEO):
        path = area.folder(GEO) / GEO_FIT
        with reporting_damage(path, "a georegistration"):
            origin = GeoFit.from_json(read_json(path)).origin
        geo = replace(geo, fit=replace(geo.fit, origin=origin))
    options = replace(options, geo=geo)
    found = plan(inputs, options.frames, extended=area, tested=area)
    if not found.sources:  # also where the same command was killed after its last change
        for stage in STAGES:
            if area.has(stage):
                watcher.unchanged(area.record(stage))
        return
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
    def report(record: StageRecord, before: StageRecord | None) -> None:
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
        time_offset_s=_geo_options(area, options).time_offset_s,
        on_telemetry=watcher.telemetry,
    )
    # Paths are relative to the folder that the area will finally have.
    final = area if extended is None else extended
    earlier = () if extended is None else extended.facts.sources
    added = [final.stored_path(path) for path in inputs]
    area.write_facts(replace(final.facts, sources=(*earlier, *added)))
    report(frames, before.get(FRAMES))
    model = build_model(
        area,
        options.model,
        watcher.progress,
        geo=_geo_options(area, options),
        extend=extended,
        overwrite=overwrite,
    )
    report(model, before.get(MODEL))
    if not has_fixes(area) and _geo_options(area, options).control is None:
        return
    try:
        geo_options = _geo_options(area, options)
        geo = georegister(area, geo_options, watcher.progress, overwrite=overwrite)
    except GeometryError as error:
        raise StageError(
            f"{area.folder(MODEL)} is complete, but it cannot be georegistered: {error}"
        ) from error
    report(geo, before.get(GEO))


def _geo_options(area: Area, options: MapOptions) -> GeoStageOptions:
    if options.geo is not None:
        return options.geo
    return recorded_options(area.record(GEO)) if area.has(GEO) else GeoStageOptions()


def _model_cost(found: Plan, options: ReconstructOptions) -> tuple[float, int]:
    """Return the expected time (s) and disk space (bytes) of the model."""
    frames = max(1, found.cost.chosen)
    reduced = options.features.max_image_size_px**2 * 9 / 16 / 1e6
    megapixels = min(found.cost.chosen_megapixels / frames, reduced)
    return estimate_model_cost(frames, megapixels, options)
