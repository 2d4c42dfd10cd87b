"""How images are scaled for networks pretrained on ImageNet; no torch in here."""

from __future__ import annotations

# Of RGB values in 0..1, as torchvision's training scripts have them.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
