"""Where COLMAP's log goes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def test_colmap_logs_to_standard_error_and_makes_no_files(tmp_path: Path) -> None:
    """COLMAP writes its log to standard error and to no file; its adjustments reset other switches."""
    program = """
import sys
from spn_data.colmap import pycolmap
pycolmap.logging.minloglevel = pycolmap.logging.Level.INFO.value
options = pycolmap.SyntheticDatasetOptions(
    num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=50
)
pycolmap.bundle_adjustment(pycolmap.synthesize_dataset(options))
pycolmap.logging.error("something went wrong")
"""
    ran = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "Global bundle adjustment" in ran.stderr
    assert "something went wrong" in ran.stderr
    assert list(tmp_path.iterdir()) == []
