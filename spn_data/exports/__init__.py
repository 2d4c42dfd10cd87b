"""Exports of camera poses to the file formats of other tools."""
