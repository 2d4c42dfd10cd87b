"""Implementation of `spn-data simulate`."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from spn_cli import console, output
from spn_data.simulate.gnss import GnssOptions
from spn_data.simulate.presets import MappingPaths
from spn_data.simulate.presets import preset as named
from spn_data.simulate.produce import simulate


def run(
    out: Path,
    preset: str,
    seed: int,
    *,
    only: tuple[str, ...],
    mapping_paths: str,
    rtk: bool,
    no_gimbal: bool,
    time_offset_s: float,
    readout_s: float,
    area_factor: float,
    length_factor: float,
) -> None:
    """Render into a new folder and print where the results are."""
    base = named(preset, seed=seed)
    options = replace(
        base,
        only=only,
        mapping_paths=MappingPaths(mapping_paths),
        gnss=GnssOptions.rtk() if rtk else base.gnss,
        gimbal_angles=not no_gimbal,
        time_offset_s=time_offset_s,
        readout_s=readout_s,
        area_factor=area_factor,
        length_factor=length_factor,
    )
    with console.progress() as progress:
        simulate(out, options, lambda done, total: progress("rendering", done, total))
    lens = options.mapping_lens.fov_deg
    output.figures(written=out, fov_deg=lens)
    console.say(f"{out}: videos in mapping/ and evaluation/, exact ground truth in truth/.")
    words = (
        "spn-data",
        "reconstruct",
        out / "mapping",
        "--area",
        out.with_name(f"{out.name}-area"),
    )
    command = shlex.join([*map(str, words), "--fov", f"{lens:g}"])
    output.figures(next={"do": "Reconstruct the mapping flights", "command": command})
    console.say(f"Next: Reconstruct the mapping flights: {command}", wrap=False)
