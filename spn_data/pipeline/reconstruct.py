"""From sources to a georeferenced model: the stages of an area in their order, and its extension."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from spn_data.area import FRAMES, GEO, MODEL, Area, Facts, StageRecord, read_json
from spn_data.errors import GeometryError, StageError
from spn_data.frames import read_frames
from spn_data.georegister.result import GeoFit
from spn_data.pipeline.frames import FramesOptions, Plan, choose_frames, plan
from spn_data.pipeline.geo import GeoStageOptions, georegister, has_fixes
from spn_data.pipeline.model import build_model
from spn_data.reconstruct import ReconstructOptions
from spn_data.telemetry.track import TelemetrySummary


@dataclass(frozen=True, kw_only=True)
class Options:
    """Of all stages."""

    frames: FramesOptions = field(default_factory=FramesOptions)
    model: ReconstructOptions = field(default_factory=ReconstructOptions)
    geo: GeoStageOptions = field(default_factory=GeoStageOptions)


class Watcher(Protocol):
    """Who looks on while the stages are made."""

    def progress(self, step: str, done: int, total: int) -> None: ...

    def planned(self, found: Plan) -> None: ...

    def telemetry(self, sequence: str, summary: TelemetrySummary | None) -> None: ...

    def stage(self, record: StageRecord) -> None: ...


def reconstruct(
    area: Area, inputs: list[Path], options: Options, watcher: Watcher, *, overwrite: bool = False
) -> None:
    """Frames, model and georegistration of the inputs. A stage made of the same is left as it is.

    Without telemetry there is no stage 3-geo. Raises StageError where telemetry does not determine the
    place in the world; the model stands then all the same.
    """
    _stages(area, inputs, options, watcher, overwrite=overwrite, extended=None)
    area.write_facts(Facts(sources=tuple(str(path) for path in inputs)))


def add(area: Area, inputs: list[Path], options: Options, watcher: Watcher) -> None:
    """Extend the area by the inputs; it stays as it is until its next version is complete.

    Frames, features and matches are taken over, the origin is kept, the map is made anew.
    """
    for stage in (FRAMES, MODEL):
        if not area.has(stage):
            raise StageError(f"{area.folder(stage)} is missing: nothing to add to; leave out --add")
    if area.has(GEO):
        origin = GeoFit.from_json(read_json(area.folder(GEO) / "geo.json")).origin
        fit = replace(options.geo.fit, origin=origin)
        options = replace(options, geo=replace(options.geo, fit=fit))
    following = area.next_area()
    _stages(following, inputs, options, watcher, overwrite=False, extended=area)
    following.write_facts(Facts(sources=(*area.facts.sources, *(str(path) for path in inputs))))
    area.take_next()


def _stages(
    area: Area,
    inputs: list[Path],
    options: Options,
    watcher: Watcher,
    *,
    overwrite: bool,
    extended: Area | None,
) -> None:
    taken: set[str] = set()
    if extended is not None:
        frames = read_frames(extended.folder(FRAMES) / "frames.csv")
        taken = set(frames.sequences.tolist())
    found = plan(inputs, options.frames, taken)
    watcher.planned(found)
    watcher.stage(
        choose_frames(
            area,
            found,
            options.frames,
            watcher.progress,
            extend=extended,
            overwrite=overwrite,
            tell=watcher.telemetry,
        )
    )
    watcher.stage(
        build_model(area, options.model, watcher.progress, extend=extended, overwrite=overwrite)
    )
    if not has_fixes(area):
        return
    try:
        watcher.stage(georegister(area, options.geo, watcher.progress, overwrite=overwrite))
    except GeometryError as error:
        raise StageError(
            f"{area.folder(MODEL)} is complete, but its place in the world is refused: {error}"
        ) from error
