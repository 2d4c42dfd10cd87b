"""Errors of estimated poses, baselines, calibration of covariances, and figures of both."""
