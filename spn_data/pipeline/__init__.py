"""Stages of an area, from videos and photos to the data set, its report and exports."""
