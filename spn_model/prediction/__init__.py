"""Poses of arbitrary photos and videos from a trained network."""
