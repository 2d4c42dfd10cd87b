"""Feature maps of SqueezeNet 1.1 trained on ImageNet, for retrieval without training on the area."""

from __future__ import annotations

import numpy as np
import torch

from spn_model.evaluation.baselines import FeatureMaps
from spn_model.networks.imagenet import MEAN, STD
from spn_model.networks.squeezeposenet import SqueezePoseNet, SqueezePoseNetOptions
from spn_model.pretrained.tensors import load_pretrained, read_tensors
from spn_model.pretrained.weights import find

WEIGHTS = "squeezenet1_1-features"


def squeezenet_maps(weights: str = WEIGHTS) -> FeatureMaps:
    """Return a function that computes the fire9 maps (B, 512, about H / 16, about W / 16) of RGB images.

    The maps are non-negative, images (B, H, W, 3) uint8. weights : a name in the catalogue of weights, or a
    file. Raises InputError if the weights cannot be found.
    """
    # Slope 0 gives the ReLU of the pretraining; untrained batch normalisation is the identity to 1e-5.
    network = SqueezePoseNet(SqueezePoseNetOptions(slope=0.0))
    path = find(weights)
    load_pretrained(network, read_tensors(path), path)
    network.eval()
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))

    def maps(images: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            pixels = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
            return np.asarray(network.features((pixels - mean) / std).numpy())

    return maps
