"""Trained networks in the folders of an area: training, evaluation, export and prediction of a run."""
