"""Simulated flights over four places with exact ground truth, for the demo, tests and what-if studies."""

from spn_data.simulate.flight import (
    FlightPath,
    FlightTelemetry,
    simulate_paths,
    simulate_telemetry,
)
from spn_data.simulate.gnss import GnssOptions, gnss_errors
from spn_data.simulate.presets import (
    PRESETS,
    LensOptions,
    MappingPaths,
    SimulateOptions,
    preset,
)
from spn_data.simulate.produce import simulate
from spn_data.simulate.truth import Truth, read_truth

__all__ = [
    "PRESETS",
    "FlightPath",
    "FlightTelemetry",
    "GnssOptions",
    "LensOptions",
    "MappingPaths",
    "SimulateOptions",
    "Truth",
    "gnss_errors",
    "preset",
    "read_truth",
    "simulate",
    "simulate_paths",
    "simulate_telemetry",
]
