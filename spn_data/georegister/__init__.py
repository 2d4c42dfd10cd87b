"""Georegistration: a model in its own gauge and telemetry give the model's place in the world, in metres."""

from spn_data.georegister.crossval import HeldOut
from spn_data.georegister.observe import align_telemetry
from spn_data.georegister.offset import OffsetOptions, TimeOffset, estimate_time_offset
from spn_data.georegister.options import GeoregisterOptions, Heights
from spn_data.georegister.register import georegister
from spn_data.georegister.result import FitSummary, GeoFit
from spn_data.georegister.uncertainty import GeoErrors, Uncertainty, georegistration_errors

__all__ = [
    "FitSummary",
    "GeoErrors",
    "GeoFit",
    "GeoregisterOptions",
    "Heights",
    "HeldOut",
    "OffsetOptions",
    "TimeOffset",
    "Uncertainty",
    "align_telemetry",
    "estimate_time_offset",
    "georegister",
    "georegistration_errors",
]
