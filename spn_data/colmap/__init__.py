"""The only package that uses pycolmap: database, verification, mapping, bundle adjustment, model files.

Import pycolmap from here: cv2 must be loaded before it, otherwise writing a PNG aborts the process.
"""

import cv2  # noqa: F401  (must be loaded first)
import pycolmap

# Keep COLMAP's log off the terminal; child processes write theirs to a log file.
pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
pycolmap.logging.alsologtostderr = False

__all__ = ["pycolmap"]
