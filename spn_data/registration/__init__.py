"""Evaluation frames in a frozen map: their poses, how far to trust them, and which of them failed."""
