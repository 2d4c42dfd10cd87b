"""The only package that uses pycolmap: database, verification, mapping, bundle adjustment, model files.

Import pycolmap from here: cv2 must be loaded before it, otherwise writing a PNG aborts the process.
"""

import signal
import threading

import cv2  # noqa: F401  (must be loaded first)
import pycolmap

# Keep COLMAP's log off the terminal; the standard error of child processes is a log file. COLMAP would make
# log files of its own, in the folder for temporary files or, where that is read-only, in the current one.
_level = pycolmap.logging.Level
pycolmap.logging.minloglevel = _level.ERROR.value
pycolmap.logging.stderrthreshold = _level.INFO.value
for _severity in (_level.INFO, _level.WARNING, _level.ERROR, _level.FATAL):
    pycolmap.logging.set_log_destination(_severity, "")

# Its import replaces the handler of SIGTERM by one that prints a native stack trace.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

__all__ = ["pycolmap"]
