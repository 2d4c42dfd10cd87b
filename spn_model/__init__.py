"""Pose networks trained on a data set: training, evaluation, prediction, and deployment on board."""
