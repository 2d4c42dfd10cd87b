"""Atomic files, locks, JSON and CSV files, and the record of a stage."""
