"""Data set files: dataset.h5, and lists and models in the formats of Cambridge Landmarks and VisualSFM."""
