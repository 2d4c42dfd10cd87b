"""Preparation of an area for visual localization: from flight video to a georeferenced map and labels."""

__version__ = "0.2.0.dev0"
