"""Preparation of an area for visual localization: from flight video to a georeferenced map and labels."""
