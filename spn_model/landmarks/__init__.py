"""Landmarks on board: a compact map of an area, and centimetre poses of images matched with it."""
