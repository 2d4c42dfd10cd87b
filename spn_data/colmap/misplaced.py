"""Detection of images with wrong poses: they observe hardly any point of the model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spn_data.colmap.model import load_native, registered_images, write_native

# Points that an image observes, divided by its number of matches with its best neighbour: at least 0.8 for a
# correct pose, at most 0.1 for a wrong one.
_MIN_OBSERVED = 0.25


def drop_misplaced(source: Path, target: Path, matches: Mapping[tuple[str, str], int]) -> list[str]:
    """Find images with wrong poses and, if there are any, write the model without them.

    An image that matches other images of the model well must observe its points. A pose that agrees with a
    few chance matches has small reprojection errors, but hardly any points.

    Parameters
    ----------
    source : Path
        Folder of the model.
    target : Path
        Folder to write; not created if all images are correct.
    matches : mapping of (str, str) to int
        Number of verified matches of each pair of image names.

    Returns
    -------
    list of str
        Sorted names of the images with wrong poses.

    Raises
    ------
    FormatError
        If `source` is not a complete model.
    StageError
        If the disk is full.
    """
    native = load_native(source)
    images = {image.name: image for image in registered_images(native)}
    best = dict.fromkeys(images, 0)
    for pair, n in matches.items():
        if all(name in images for name in pair):
            for name in pair:
                best[name] = max(best[name], n)
    wrong = [name for name in images if images[name].num_points3D < _MIN_OBSERVED * best[name]]
    if wrong:
        for name in wrong:
            native.deregister_frame(images[name].frame_id)
        write_native(native, target)
    return sorted(wrong)
