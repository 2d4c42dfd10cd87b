"""Covariance of a frozen map: of its poses, intrinsics and points."""
