"""Onboard localization with a bundle: NumPy, OpenCV and onnxruntime only, without torch."""
