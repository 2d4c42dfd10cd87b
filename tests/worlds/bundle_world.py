"""Network overfitted to four views of the painted hall, for bundles that run on a drone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.geometry.camera import Camera
from spn_model.examples.dataset_view import view_of
from spn_model.examples.training_set import TrainingSet
from spn_model.models.checkpoint import Checkpoint
from spn_model.models.scene_coordinates import SceneCoordinatesModel
from spn_model.training.precision import bfloat16_is_fast

STEPS = 100
# A lens with distortion and a slightly wider field of view than the dataset's camera.
LENS = Camera("OPENCV", 640, 360, np.array([425.0, 428.0, 322.0, 178.0, -0.06, 0.02, 1e-3, -5e-4]))
_NO_AUGMENTATION = {
    **{"tilt_deg": 0, "roll_deg": 0, "zoom_min": 1, "zoom_max": 1},
    **{"size_min": 1, "size_max": 1, "ramp_share": 0, "look": False},
}


def learnt(dataset: Path) -> Checkpoint:
    """Train a scene-coordinate network for 100 steps on the training images without augmentation."""
    with Dataset(dataset) as data:
        training, view = TrainingSet(data.groups["train"]), view_of(data)
    model = SceneCoordinatesModel.make({"shrink": 2}, seed=0)
    model.load_pretrained(model.weights_name)
    model.fit(training)
    model.begin_stage(_NO_AUGMENTATION, training)
    model.bfloat16 = bfloat16_is_fast("cpu")
    optimizer = torch.optim.AdamW([{**group, "lr": 0.0} for group in model.parameter_groups()])
    generator, rows = np.random.default_rng(0), np.arange(len(training))
    model.network.train()
    for step in range(STEPS):
        rate = 3e-3 * min(1, (step + 1) / 10) * (1 + np.cos(np.pi * step / STEPS)) / 2
        for group in optimizer.param_groups:
            group["lr"] = rate * group["rate"]
        loss, _ = model.loss(model.batch(training, rows, generator, step / STEPS))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.network.parameters(), 5.0)
        optimizer.step()
    model.network.eval()
    return Checkpoint(model, view, {"recipe": {"weights": "published"}})
