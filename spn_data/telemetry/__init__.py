"""Telemetry of drones and GNSS loggers: readers for each format and one common representation."""
