"""Tracking of map points from labelled frames into the video frames between them."""
