"""Georegistration: from the gauge of a reconstruction to a metric East-North-Up frame, using telemetry."""

from spn_data.georegistration.cross_validation import HeldOut
from spn_data.georegistration.georegister import georegister
from spn_data.georegistration.georegister_options import GeoregisterOptions, Heights
from spn_data.georegistration.observe import align_telemetry
from spn_data.georegistration.offset import OffsetOptions, TimeOffset, estimate_time_offset
from spn_data.georegistration.result import FitSummary, GeoFit
from spn_data.georegistration.uncertainty import GeoErrors, Uncertainty, georegistration_errors

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
