"""Telemetry in the format of DJI subtitle files, with one record per video frame."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np

from spn_data.simulate.flight import FlightTelemetry

TAKEOFF = datetime(2026, 5, 17, 10, 30)  # nominal; each flight's clock starts here


def srt_text(telemetry: FlightTelemetry, fps: float) -> str:
    """Format the records: positions with 6 decimals of a degree, heights with 3, gimbal angles with 1."""
    lines = []
    for i, time_s in enumerate(telemetry.time_s):
        end_s = (i + 1) / fps
        lat, lon = telemetry.lat_lon_deg[i]
        fields = (
            "[iso: 100] [shutter: 1/500.0] [fnum: 2.8] [ev: 0] "
            f"[latitude: {lat:.6f}] [longitude: {lon:.6f}] "
            f"[rel_alt: {telemetry.rel_alt_m[i]:.3f} abs_alt: {telemetry.abs_alt_m[i]:.3f}]"
        )
        heading, pitch, roll = telemetry.gimbal_deg[i]
        if np.isfinite(heading):
            heading = (heading + 180.0) % 360.0 - 180.0
            fields += f" [gb_yaw: {heading:.1f} gb_pitch: {pitch:.1f} gb_roll: {roll:.1f}]"
        clock = TAKEOFF + timedelta(seconds=float(time_s))
        lines.append(
            f"{i + 1}\n{_cue(time_s)} --> {_cue(end_s)}\n"
            f'<font size="28">FrameCnt: {i + 1}, DiffTime: {round(1000 / fps)}ms\n'
            f"{clock:%Y-%m-%d %H:%M:%S}.{clock.microsecond // 1000:03d}\n{fields} </font>\n"
        )
    return "\n".join(lines)


def _cue(time_s: float) -> str:
    ms = round(time_s * 1000)
    return f"{ms // 3600000:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d},{ms % 1000:03d}"
