"""Names of the folders and files in an area: the only place where they are defined."""

from __future__ import annotations

# Stages, a folder each.
FRAMES, MODEL, GEO, SPLIT = "1-frames", "2-model", "3-geo", "5-split"
STAGES = (FRAMES, MODEL, GEO)  # of the map; --add exchanges them together
# Groups of stages, with one stage a sequence.
EVALUATION, TRACKED = "4-eval", "4-tracked"
GROUPS = (EVALUATION, TRACKED)
FORMER_GROUPS = {TRACKED: "4-dense"}  # in areas of version 0.1; read and extended where they are

# In 1-frames.
FRAMES_TABLE, CAMERAS, TELEMETRY, MASKS = "frames.csv", "cameras.json", "telemetry", "masks"
# In 2-model.
DATABASE = "database.db"
# In 3-geo.
GEO_FIT = "geo.json"
# Labels: in 2-model and in each stage of a group.
POSES, OBSERVATIONS, CAMERA, REGISTRATION = (
    "poses.csv",
    "observations.npz",
    "camera.json",
    "registration.json",
)
TRACK = "telemetry.csv"  # of an evaluation sequence
# In 5-split.
SPLIT_FILE, DATASET, CAMBRIDGE, AUDIT = "split.json", "dataset.h5", "cambridge", "audit.json"

# Temporary files of unfinished work, by stage: removed when the stage is complete.
SCRATCH: dict[str, tuple[str, ...]] = {
    FRAMES: (".analysis",),
    MODEL: ("mapping-*", "database-*", "refined"),
    EVALUATION: (".analysis", ".matches"),
}

# Next to the stages: files that each run replaces.
COVERAGE, PLANNED_COVERAGE = "coverage", "coverage-waypoints"
REPORT = "report.html"
THUMBNAILS = ".thumbnails.json"  # cache of the small images in the report
GROUND = ".ground.json"  # cache of the image of the ground in the report

# Trained networks, a folder each; made by spn-model.
RUNS = "runs"
CHECKPOINT, LOG, METRICS = "checkpoint.safetensors", "log.csv", "metrics.json"
ERRORS, FIXES, FIGURES, BUNDLE = "errors.csv", "fixes.csv", "figures", "bundle"
BUNDLE_FACTS = "bundle.json"  # in BUNDLE
CONFIG, LAST, STATE = "config.json", "last.safetensors", "state.safetensors"
EXPECTED = "expected.json"  # what is expected of planned waypoints with the bundle
RETRIEVAL = ".retrieval.json"  # in RUNS: cache of the retrieval baselines
COMPARED = "compared"  # in RUNS: several runs evaluated together
