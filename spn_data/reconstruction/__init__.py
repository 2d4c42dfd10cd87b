"""Reconstruction of a model from frames, with retries, and its diagnosis."""
