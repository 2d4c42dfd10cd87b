"""Orthophoto of the ground: its height from map points, which frame shows it, and the mosaic."""
