"""Audit of the images in dataset.h5: copies of training images among held-out ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.pipeline.area_audit import _check_images
from spn_data.split.audit import AuditVerdict


def textured(seed: int) -> np.ndarray:
    steps = np.random.default_rng(seed).integers(0, 255, (9, 16, 3), dtype=np.uint8)
    return cv2.resize(steps, (64, 36), interpolation=cv2.INTER_NEAREST)


def verdict(path: Path, train: list[np.ndarray], test: list[np.ndarray]) -> tuple[str, str]:
    """Return verdict and first evidence of the check on a data set of these images."""
    info = DatasetInfo(units="m", origin=None, up_is_known=False, camera=None, has_images=True)
    with DatasetWriter(path, info, {"train": Role.TRAIN, "medium": Role.TEST}) as writer:
        for group, images in (("train", train), ("medium", test)):
            for k, image in enumerate(images):
                frame = DatasetFrame(
                    name=f"{group}/{k}.jpg",
                    sequence=group,
                    time_s=float(k),
                    center=np.zeros(3),
                    quat_wxyz=np.array([1.0, 0, 0, 0]),
                    intrinsics=np.full((3, 3), np.nan),
                    image=image,
                )
                writer.append(group, frame)
    with Dataset(path) as dataset:
        found = _check_images(dataset)
    return found.verdict, (*found.evidence, "")[0]


def test_a_copy_of_a_training_image_fails_the_audit(tmp_path):
    """Identical pixels fail and similar ones give a notice; other and all-black images pass."""
    black, noisy = np.zeros((36, 64, 3), np.uint8), textured(1) // 2 + 30
    noisy[::2] += 1
    train = [textured(0), textured(1) // 2 + 30, black]
    assert verdict(tmp_path / "a.h5", train, [textured(2), black]) == (AuditVerdict.PASS, "")
    found = verdict(tmp_path / "b.h5", train, [textured(2), textured(0)])
    assert found == (AuditVerdict.FAIL, "medium/1.jpg (medium) has the pixels of train/0.jpg")
    found = verdict(tmp_path / "c.h5", train, [noisy])
    assert found == (AuditVerdict.NOTICE, "medium/0.jpg looks the same as train/1.jpg")
