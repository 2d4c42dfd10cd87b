"""Create the weights shipped with the package: the features of SqueezeNet 1.1 as float16.

    python tools/shipped_weights.py squeezenet1_1-imagenet.safetensors

reads the whole network with torchvision's names, drops its classifier, rounds, and writes
spn_model/pretrained/squeezenet1_1-features.safetensors. It prints the hash of the file, which is recorded in
spn_model/pretrained/weights.py. The same input gives the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save

from spn_model.pretrained.weights import SHIPPED, by_name

ABOUT = "SqueezeNet 1.1 features, ImageNet, rounded to float16; "


def shipped(source: Path) -> bytes:
    """Return the content of the file to ship."""
    with safe_open(source, "pt") as file:
        names = [name for name in sorted(file.keys()) if name.startswith("features.")]
        tensors = {name: file.get_tensor(name).to(torch.float16) for name in names}
        origin = file.metadata()["source"]
    return save(tensors, metadata={"source": ABOUT + origin})


def main() -> None:
    """Write the file and print its hash."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    content = shipped(parser.parse_args().source)
    target = SHIPPED / by_name("squeezenet1_1-features").file
    target.write_bytes(content)
    print(f"{target}: {len(content)} bytes, sha256 {hashlib.sha256(content).hexdigest()}")


if __name__ == "__main__":
    main()
