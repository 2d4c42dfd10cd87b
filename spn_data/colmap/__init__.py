"""The only package that knows pycolmap: database, verification, mapping, model files.

Import pycolmap from here: cv2 must load before it, else writing a PNG aborts the process.
"""

import cv2  # noqa: F401  (loads first on purpose)
import pycolmap

# COLMAP's own chatter goes to no terminal; child processes send their errors to a log file.
pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
pycolmap.logging.alsologtostderr = False

__all__ = ["pycolmap"]
