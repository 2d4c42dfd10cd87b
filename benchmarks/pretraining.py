"""How much of SqueezeNet's pretraining survives the changes of the paper, on images of a dataset.

    python benchmarks/pretraining.py AREA/5-split/dataset.h5 [--images 60]

Compares the pooled features of SqueezePoseNet's trunk with those of the plain network (ReLU, no
normalisation): the norm of their difference, their correlation about their means, and the share of images
whose nearest other image in feature space is the same.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_model.networks.imagenet import MEAN, STD
from spn_model.networks.normalization import InsertedBatchNorm, initialize_as_identity
from spn_model.networks.registry import build
from spn_model.networks.regressor import Regressor
from spn_model.pretrained.tensors import load_pretrained, read_tensors
from spn_model.pretrained.weights import find


def training_images(path: Path, count: int) -> Tensor:
    """Read normalised images (B, 3, H, W) spread over the training frames."""
    with Dataset(path) as dataset:
        group = dataset.of_role(Role.TRAIN)[0]
        rows = np.linspace(0, len(group) - 1, min(count, len(group))).astype(int)
        # In random order like training batches: neighbours in time would have similar statistics.
        rows = np.random.default_rng(0).permutation(rows)
        images = np.stack([group.image(int(row)) for row in rows])
    values = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
    return (values - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]


def squeezeposenet(slope: float, *, normalised: bool) -> Regressor:
    """Build SqueezePoseNet with pretrained weights, with or without its normalisation layers."""
    network = build("squeezeposenet", {"slope": slope})
    path = find(network.weights_name)
    load_pretrained(network, read_tensors(path), path)
    if not normalised:
        for name, layer in list(network.named_modules()):
            if isinstance(layer, InsertedBatchNorm):
                parent, _, slot = name.rpartition(".")
                setattr(network.get_submodule(parent), slot, nn.Identity())
    return network.eval()


def nearest(features: Tensor) -> Tensor:
    """Return the index (B,) of the nearest other image."""
    return torch.cdist(features, features).fill_diagonal_(torch.inf).argmin(1)


def row(name: str, features: Tensor, plain: Tensor) -> tuple[str, ...]:
    """Format the comparison of features (B, F) with those of the plain network."""
    away, base = features - features.mean(0), plain - plain.mean(0)
    return (
        name,
        f"{float((features - plain).norm() / plain.norm()):.3g}",
        f"{float((away * base).sum() / (away.norm() * base.norm())):.4f}",
        f"{float((nearest(features) == nearest(plain)).float().mean()):.0%}",
    )


@torch.no_grad()
def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--images", type=int, default=60)
    given = parser.parse_args()
    torch.set_num_threads(1)
    images = training_images(given.dataset, given.images)

    def features(network: Regressor) -> Tensor:
        return torch.cat([network.trunk(batch)[0] for batch in images.split(10)])

    plain = features(squeezeposenet(0.0, normalised=False))
    table = Table("trunk", "difference", "correlation", "same nearest image", box=None)
    for slope in (0.001, 0.01, 0.03, 0.1):
        leaky = features(squeezeposenet(slope, normalised=False))
        table.add_row(*row(f"slope {slope}", leaky, plain))
    ours = squeezeposenet(0.01, normalised=True)
    # With batch statistics instead of running ones: the state at the beginning of training.
    table.add_row(*row("slope 0.01, fresh normalisation", features(ours.train()), plain))
    ours = squeezeposenet(0.01, normalised=True)
    initialize_as_identity(ours, images.split(10))
    table.add_row(*row("slope 0.01, identity, in use", features(ours.eval()), plain))
    table.add_row(*row("slope 0.01, identity, in training", features(ours.train()), plain))
    console = Console()
    console.print(f"{len(images)} images of {images.shape[3]} x {images.shape[2]}")
    console.print(table)


if __name__ == "__main__":
    main()
