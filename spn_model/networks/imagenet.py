"""Mean and standard deviation of ImageNet, used to normalise network inputs; imports no torch."""

from __future__ import annotations

# Mean and standard deviation of RGB values in 0..1, as in torchvision's training scripts.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
