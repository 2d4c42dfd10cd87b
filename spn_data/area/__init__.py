"""The layout of an area on disk and its stages."""
