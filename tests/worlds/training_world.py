"""Coloured field seen from straight above, and a small network that locates images by their colours."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats
from spn_model.examples.training_set import TrainingSet
from spn_model.models import registry
from spn_model.models.checkpoint import load
from spn_model.models.pose_model import UNKNOWN_COUNT, Batch, PoseEstimates, PoseModel
from spn_model.training.train import TrainOptions
from spn_model.training.training_record import Files

CAMERA = Camera("SIMPLE_PINHOLE", 64, 48, np.array([40.0, 32.0, 24.0]))
INFO = DatasetInfo(
    units="m",
    origin=GeoOrigin(-33.86, 151.2, 12.5, HeightReference.TAKEOFF),
    up_is_known=True,
    camera=CAMERA,
    fingerprints={"3-geo": "0123456789abcdef"},
)
HEIGHT_M, PX_PER_M = 10.0, 4.0
ONE_THREAD = TrainOptions(seed=5, threads=1, device="cpu", precision="float32", validations=4)


# In two stages, within seconds.
TINY_RECIPE = """\
kind = "tiny"
weights = "none"

[[stages]]
name = "head"
images = 40
batch = 5
rate = 0.02
options = { frozen = true }

[[stages]]
name = "all"
images = 120
batch = 6
rate = 0.02
"""


def field_image() -> np.ndarray:
    """Paint the field (400, 400, 3) uint8: red grows eastwards, green northwards; blue blobs never repeat."""
    y, x = np.mgrid[0:400, 0:400] / 400.0
    noise = np.random.default_rng(5).standard_normal((400, 400)).astype(np.float32)
    blobs = cv2.GaussianBlur(noise, (0, 0), 9)
    return np.clip(
        np.stack([40 + 180 * x, 220 - 180 * y, 128 + 30 * blobs / blobs.std()], axis=-1), 0, 255
    ).astype(np.uint8)


def frame(group: str, k: int) -> DatasetFrame:
    """Render frame k of a group from a random position, north up in the image, with four ground points."""
    rng = np.random.default_rng([k, *group.encode()])
    east, north = rng.uniform(-36, 36, 2)
    yaw = rng.uniform(-0.2, 0.2)
    # Straight down, image x to the east, then turned about the optical axis.
    quat = canonical_quats(np.array([0.0, np.cos(yaw / 2), np.sin(yaw / 2), 0.0]))
    center = np.array([east, north, HEIGHT_M])
    rotation = Poses(center[None], quat[None]).rotations[0]
    pixels = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1).reshape(-1, 2)
    rays = np.column_stack([CAMERA.unproject(pixels), np.ones(len(pixels))]) @ rotation
    ground = center + rays * (-HEIGHT_M / rays[:, 2])[:, None]
    at = (ground[:, :2] * [1, -1] * PX_PER_M + 200).astype(np.float32).reshape(48, 64, 2)
    image = cv2.remap(field_image(), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=4)
    seen = [0, 63, 64 * 47, 64 * 47 + 63]
    return DatasetFrame(
        name=f"flight {group}/{k:06d}.jpg",
        sequence=f"flight {group}",
        time_s=0.1 * k,
        center=center,
        quat_wxyz=quat,
        intrinsics=CAMERA.matrix,
        image=image,
        point_ids=np.arange(4) + 1,
        point_pixels=pixels[seen],
        point_xyz=ground[seen],
    )


def write_field(
    path: Path,
    train: int = 24,
    validation: int = 6,
    *,
    moved_by: tuple[float, float, float] = (0.0, 0.0, 0.0),
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Path:
    """Write a dataset of the field, moved in the world, to a path, which is returned."""
    info = replace(INFO, origin=None, up_is_known=False, offset=offset) if any(moved_by) else INFO
    roles = {"train": Role.TRAIN, "validation": Role.VALIDATION}
    with DatasetWriter(path, info, roles) as writer:
        for group, count in (("train", train), ("validation", validation)):
            for k in range(count):
                writer.append(group, moved(frame(group, k), moved_by))
    return path


def moved(one: DatasetFrame, by: tuple[float, float, float]) -> DatasetFrame:
    """Return a frame elsewhere in the world."""
    return replace(one, center=one.center + by, point_xyz=one.point_xyz + by)


class TinyNet(nn.Module):
    """Network from images (B, 3, H, W) in 0..1 to (B, 7): scaled position and quaternion."""

    center: Tensor
    scale: Tensor
    variance: Tensor

    def __init__(self, width: int, dropout: float, normalised: bool):
        super().__init__()
        self.convolution = nn.Conv2d(3, width, 4, stride=4)
        self.normalisation = nn.BatchNorm2d(width) if normalised else nn.Identity()
        self.dropout = nn.Dropout(dropout)
        self.out = nn.Linear(width, 7)
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("variance", torch.ones(()))

    def forward(self, images: Tensor) -> Tensor:
        x = self.normalisation(self.convolution(images)).relu()
        return self.out(self.dropout(x.mean(dim=(2, 3))))


class TinyModel(PoseModel):
    """Pose regression small enough for tests."""

    kind: ClassVar[str] = "tiny"
    weights_name = ""

    def __init__(self, width: int, dropout: float, normalised: bool):
        self._options = {"width": width, "dropout": dropout, "normalised": normalised}
        self.network: TinyNet = TinyNet(width, dropout, normalised)
        self._brightness = 0.0
        self._sick_at = 2.0

    @classmethod
    def make(cls, options: Mapping[str, Any], seed: int) -> Self:
        chosen = {"width": 8, "dropout": 0.1, "normalised": True}
        for name, value in options.items():
            if name not in chosen:
                raise InputError(f"kind tiny has no option {name!r}")
            chosen[name] = value
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return cls(**chosen)

    @property
    def options(self) -> dict[str, Any]:
        return dict(self._options)

    def load_pretrained(self, weights: str) -> None:
        raise InputError("has no published weights", path=weights)

    def fit(self, data: TrainingSet) -> None:
        centers = torch.from_numpy(data.poses.centers).float()
        self.network.center.copy_(centers.mean(dim=0))
        self.network.scale.copy_(centers.std(dim=0).max())

    def begin_stage(
        self, stage: Mapping[str, Any], data: TrainingSet, images: int = UNKNOWN_COUNT
    ) -> None:
        unknown = [name for name in stage if name not in ("frozen", "brightness", "sick_at")]
        if unknown:
            raise InputError(f"kind tiny has no option {unknown[0]!r}")
        self._brightness = float(stage.get("brightness", 0.0))
        self._sick_at = float(stage.get("sick_at", 2.0))
        self.network.convolution.requires_grad_(not stage.get("frozen", False))

    def parameter_groups(self) -> list[dict[str, Any]]:
        first = [p for p in self.network.convolution.parameters() if p.requires_grad]
        rest = [*self.network.normalisation.parameters(), *self.network.out.parameters()]
        groups = [{"name": "added", "params": rest, "rate": 1.0}]
        return groups + ([{"name": "pretrained", "params": first, "rate": 0.3}] if first else [])

    def batch(
        self, data: TrainingSet, rows: np.ndarray, generator: np.random.Generator, progress: float
    ) -> Batch:
        gain = 1 + self._brightness * generator.standard_normal((len(rows), 1, 1, 1))
        images = np.stack([data.image(int(row)) for row in rows]) / 255 * gain
        if progress >= self._sick_at:  # simulates a broken camera or an overflow
            images = images * np.nan
        return {
            "images": torch.from_numpy(images.astype(np.float32)).permute(0, 3, 1, 2),
            "centers": torch.from_numpy(data.poses.centers[rows]).float(),
            "quats": torch.from_numpy(data.poses.quats_wxyz[rows]).float(),
        }

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        images = batch["images"]
        with torch.autocast(images.device.type, torch.bfloat16, enabled=self.bfloat16):
            out = self.network(images)
        out = out.float()
        where = (batch["centers"] - self.network.center) / self.network.scale
        position = (out[:, :3] - where).norm(dim=1).mean()
        turn = (out[:, 3:] - batch["quats"]).norm(dim=1).mean()
        return position + turn, {"position": position.detach(), "turn": turn.detach()}

    @torch.no_grad()
    def estimate(self, images, intrinsics, verticals=None) -> PoseEstimates:
        device = self.network.center.device
        out = self.network(torch.from_numpy(images / 255.0).float().permute(0, 3, 1, 2).to(device))
        centers = (out[:, :3] * self.network.scale + self.network.center).double().cpu().numpy()
        quats = nn.functional.normalize(out[:, 3:].double(), dim=1).cpu().numpy()
        covariance = np.tile(np.eye(6) * float(self.network.variance), (len(images), 1, 1))
        return PoseEstimates(Poses(centers, quats), covariance, np.full(len(images), ""))

    def set_covariance_scale(self, factor: float) -> None:
        self.network.variance.mul_(factor)


def register_tiny() -> None:
    """Register the kind for recipes and checkpoints of this process."""
    registry.KINDS["tiny"] = (__name__, "TinyModel")


class Follower:
    """Follower of a training that keeps the log rows and requests a stop after some steps."""

    def __init__(self, stop_after: int = 10**9):
        self.rows: list[Mapping[str, Any]] = []
        self._left = stop_after

    def row(self, values: Mapping[str, Any]) -> None:
        self.rows.append(dict(values))

    def wants_stop(self) -> bool:
        self._left -= 1
        return self._left < 0

    def is_stopping(self) -> bool:
        return self._left < 0


def files(folder: Path) -> Files:
    """Return the files of a training in a folder, which is created."""
    folder.mkdir(exist_ok=True)
    names = ("checkpoint.safetensors", "last.safetensors", "state.safetensors", "log.csv")
    return Files(*(folder / name for name in names))


def weights(path: Path) -> dict[str, torch.Tensor]:
    """Return the weights of a checkpoint."""
    return load(path).model.network.state_dict()


def log(folder: Path) -> list[dict[str, str]]:
    """Read the rows of a training's log."""
    with (folder / "log.csv").open(newline="") as file:
        return list(csv.DictReader(file))
