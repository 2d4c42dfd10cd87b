"""Camera view that a network is trained for, as a data set defines it."""

from __future__ import annotations

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.storage.fingerprints import content_fingerprint
from spn_model.onboard.view import View


def view_of(dataset: Dataset) -> View:
    """Return camera, image size and world of a data set.

    Raises ValueError unless its training images have exactly one size.
    """
    sizes = {g.image_size for g in dataset.groups.values() if g.role is Role.TRAIN} - {None}
    if len(sizes) != 1:
        raise ValueError(f"training images have {len(sizes)} different sizes, one is needed")
    info, size = dataset.info, sizes.pop()
    assert size is not None
    return View(
        camera=info.camera,
        size=size,
        units=info.units,
        origin=info.origin,
        up_is_known=info.up_is_known,
        dataset=content_fingerprint(dataset.path),
        made_from=dict(info.fingerprints),
        offset=info.offset,
    )
