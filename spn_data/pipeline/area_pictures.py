"""Pictures of the report: what networks estimated, and images of frames, the worst ones first."""

from __future__ import annotations

from spn_data.area.area import Area
from spn_data.inputs.run_estimates import read_estimates
from spn_data.inputs.thumbnails import read_thumbnails
from spn_data.pipeline.area_ground import ground_of
from spn_data.pipeline.fresh_stages import FreshStages
from spn_data.report.data import ReportData
from spn_data.report.pictures import Pictures, fits_labels, worst_frames


def pictures_of(area: Area, data: ReportData) -> Pictures:
    """Read estimates and images; worst frames, and training frames beside them, come before others."""
    found, notes = read_estimates(area, data.runs)
    fitting = [fits_labels(data.frames, one) for one in found]
    estimates = tuple(one for one, fits in zip(found, fitting, strict=True) if fits)
    moved = dict.fromkeys(one.run for one, fits in zip(found, fitting, strict=True) if not fits)
    notes += tuple(
        f"estimates of {run} are of other labels than those of the area, and not shown; run spn-data split, "
        f"then spn-model evaluate --run {run}"
        for run in moved
    )
    worst = worst_frames(data.frames, estimates)
    wanted = {name for one in worst for name in (one.name, one.nearest, one.taken_for)}
    images = read_thumbnails(area, data.frames, wanted)
    ground, ground_note = ground_of(FreshStages(area))
    return Pictures(
        estimates=estimates,
        worst=worst,
        thumbnails=images.images,
        files=images.files,
        ground=ground,
        notes=(*notes, *images.notes, *filter(None, [ground_note])),
    )
