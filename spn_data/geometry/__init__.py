"""Poses, cameras, geodesy and the least-squares building blocks that are shared by everything else."""
