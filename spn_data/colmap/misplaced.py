"""Images of a model that lie where they show next to nothing of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spn_data.colmap.model import load_native, registered_images, write_native

# Points that an image shows, as a share of its matches with one other: 0.8 and more where it lies rightly,
# 0.1 at most where it does not.
_SHOWN = 0.25


def drop_misplaced(source: Path, target: Path, matches: Mapping[tuple[str, str], int]) -> list[str]:
    """Names of the images that the model in `source` places wrongly; where there are any, the model without
    them is written to `target`.

    matches : verified ones of each pair of names. An image that matches others of the model well must show
    its points; a pose that a few chance matches agree with has small reprojection errors, and no points else.
    """
    native = load_native(source)
    images = {image.name: image for image in registered_images(native)}
    best = dict.fromkeys(images, 0)
    for pair, n in matches.items():
        if all(name in images for name in pair):
            for name in pair:
                best[name] = max(best[name], n)
    wrong = [name for name in images if images[name].num_points3D < _SHOWN * best[name]]
    if wrong:
        for name in wrong:
            native.deregister_frame(images[name].frame_id)
        write_native(native, target)
    return sorted(wrong)
