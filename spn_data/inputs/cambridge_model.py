"""The model beside lists in the format of Cambridge Landmarks: whether poses and image sizes agree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.capture.photos import decode_photo, read_headers
from spn_data.dataset.cambridge import NVM
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.nvm import NvmModel, read_nvm_models
from spn_data.dataset.nvm_extents import Extents, shrunken_sizes, stored_orientation
from spn_data.dataset.nvm_frames import NvmFrames
from spn_data.dataset.pose_agreement import name_disagreement
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rendering import RenderingOptions, canonical_camera
from spn_data.inputs.cambridge_frames import LISTS, ListedFrames, first_name

_FEW, _NEARLY_ALL = 3, 0.8
_OTHER_SIZE = (
    f"use the images that {NVM} was made of, or remove it to go without focal lengths and points"
)
_CHECK_TURN = (
    "if the poses are of the stored pixels, remove the EXIF orientation (exiftool -Orientation=)"
)
_TURNED = {
    True: f"read as stored, although the EXIF says to turn them, because {NVM} was made of the stored "
    "pixels",
    False: f"turned upright by their EXIF, as the images that {NVM} was made of",
    None: "turned upright by their EXIF; nothing shows whether the poses are of the upright image: "
    + _CHECK_TURN,
}


@dataclass(frozen=True, eq=False)
class OpenedFrames:
    """N frames whose image headers were read.

    Attributes
    ----------
    frames : ListedFrames
        The frames.
    model : NvmFrames or None
        Their model.
    upright : ndarray of bool, shape (N,)
        Whether the EXIF orientation of the image is applied.
    """

    frames: ListedFrames
    model: NvmFrames | None
    upright: np.ndarray


def read_model(
    folder: Path, frames: ListedFrames, subtract: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[NvmFrames | None, list[str]]:
    """Read the model that most listed frames agree with.

    Parameters
    ----------
    folder : Path
        Folder with `reconstruction.nvm`, or without it.
    frames : ListedFrames
        Frames of the lists, of whose positions `subtract` is subtracted.
    subtract : tuple of float
        Offset to subtract from the model's positions.

    Returns
    -------
    model : NvmFrames or None
        The model; None if there is no file.
    notes : list of str
        One sentence each.

    Raises
    ------
    InputError
        If the file is damaged, or if list and model disagree on nearly all poses.
    """
    path = folder / NVM
    if not path.is_file():
        return None, [f"no {NVM}: focal lengths are unknown and there are no map points"]
    is_training = frames.roles == Role.TRAIN
    offset = np.array(subtract)
    models = [
        NvmFrames(_shifted(model, offset), frames.names, frames.poses, is_training)
        for model in read_nvm_models(path)
    ]
    number = max(
        range(len(models)),
        key=lambda k: (int(models[k].has_points.sum()), int(models[k].is_known.sum()), -k),
    )
    model, notes = models[number], []
    if len(models) > 1:
        notes.append(
            f"{NVM} contains {len(models)} models; number {number + 1} is used, which has "
            f"{int(model.is_known.sum())} of the {len(frames.names)} listed images"
        )
    _check_poses(path, frames, model)
    return model, notes + _model_notes(frames, model)


def _shifted(model: NvmModel, offset: np.ndarray) -> NvmModel:
    if not offset.any():
        return model
    poses = Poses(model.poses.centers - offset, model.poses.quats_wxyz)
    return replace(model, poses=poses, xyz=model.xyz - offset)


def _check_poses(path: Path, frames: ListedFrames, model: NvmFrames) -> None:
    """Refuse a list that disagrees with the model in nearly all frames, or in some by another convention."""
    rows = np.flatnonzero(model.is_known & ~model.has_points)
    known = int(model.is_known.sum())
    if len(rows) < min(_FEW, known) or not len(rows):
        return
    cause = name_disagreement(frames.poses[rows], model.model_poses(rows))
    if not cause and len(rows) < _NEARLY_ALL * known:
        return
    found = f"they agree if {cause}" if cause else "no usual mistake of conventions explains that"
    raise InputError(
        f"{first_name([frames.names[k] for k in rows])}: the pose in the list is not that in {NVM}, for "
        f"{len(rows)} of {known} images; {found}; correct the lists, or remove {NVM} if the lists are right",
        path=path,
    )


def _model_notes(frames: ListedFrames, model: NvmFrames) -> list[str]:
    notes = []
    for rows, what in (
        (~model.is_known, f"not in {NVM}, so the focal length is unknown"),
        (
            model.is_known & ~model.has_points,
            f"the pose in {NVM} is different, so its map points are left out",
        ),
    ):
        if rows.any():
            notes.append(f"{first_name([frames.names[k] for k in np.flatnonzero(rows)])}: {what}")
    return notes


def check_sizes(
    folder: Path, frames: ListedFrames, model: NvmFrames | None, width_px: int
) -> tuple[OpenedFrames, list[str]]:
    """Check image sizes against each other and the model; decide whether EXIF turns the images.

    Parameters
    ----------
    folder : Path
        Folder of the lists.
    frames : ListedFrames
        Frames with their image files.
    model : NvmFrames or None
        Their model.
    width_px : int
        Width of the images in the data set.

    Returns
    -------
    opened : OpenedFrames
        The frames, and how to decode their images.
    notes : list of str
        One sentence each.

    Raises
    ------
    InputError
        If an image cannot be read, if the model was made of images of another size or orientation, or if
        images of one list differ in shape.
    """
    n = len(frames.names)
    upright = np.ones(n, dtype=bool)
    files = [file for file in frames.files if file is not None]
    if len(files) < n:  # there is no image at all
        return OpenedFrames(frames, model, upright), []
    headers = read_headers(files)
    for k, problem in enumerate(headers.problem):
        if problem:
            decode_photo(files[k])  # names what is wrong with the image
            raise InputError(problem, path=files[k])
    sizes = headers.sizes
    orientation = np.array([m.orientation for m in headers.metadata if m is not None])
    stored = np.where(orientation[:, None] >= 5, sizes[:, ::-1], sizes)
    turned = np.flatnonzero(orientation != 1)
    extents = None if model is None else Extents.of(model, n)
    notes = []
    if len(turned):
        is_stored = None if extents is None else stored_orientation(extents, sizes, stored, turned)
        if is_stored:
            upright[turned] = False
            sizes = np.where(upright[:, None], sizes, stored)
        notes.append(f"{first_name([frames.names[k] for k in turned])}: {_TURNED[is_stored]}")
    if extents is not None and model is not None:
        notes += _check_extents(folder / NVM, frames, model, extents, sizes)
    _check_shapes(frames, sizes, width_px)
    return OpenedFrames(frames, model, upright), notes


def _check_extents(
    path: Path, frames: ListedFrames, model: NvmFrames, extents: Extents, sizes: np.ndarray
) -> list[str]:
    """Refuse images of another size than those that the model was made of; return notes."""
    bad = np.flatnonzero(extents.misfits(sizes))
    if len(bad):
        k = int(bad[0])
        span = " x ".join(f"{2 * value:.0f}" for value in extents.half_px[k])
        raise InputError(
            f"{first_name([frames.names[row] for row in bad])}: the image is {sizes[k, 0]}x{sizes[k, 1]}, "
            f"but the model's measurements in it span {span} pixels, so it was made of images of another "
            f"size or orientation; {_OTHER_SIZE}",
            path=path,
        )
    refusal, note = shrunken_sizes(extents, model, sizes, frames.names)
    if refusal:
        message = f"{refusal}; {_OTHER_SIZE}"
        raise InputError(message, path=path)
    notes = [note] if note else []
    outside = int(extents.outside(sizes).sum())
    if outside:
        notes.append(f"{outside} measurements of {NVM} are outside their images and are left out")
    return notes


def _check_shapes(frames: ListedFrames, sizes: np.ndarray, width_px: int) -> None:
    """Refuse images of one group that would have different sizes in the data set."""
    first: dict[str, int] = {}
    for k, (role, (width, height)) in enumerate(zip(frames.roles, sizes, strict=True)):
        row = first.setdefault(str(role), k)
        reference = Camera.from_horizontal_fov(int(sizes[row, 0]), int(sizes[row, 1]), 60.0)
        own = Camera.from_horizontal_fov(int(width), int(height), 60.0)
        rendering = RenderingOptions(width_px=width_px)
        if (
            canonical_camera([own], rendering).height
            != canonical_camera([reference], rendering).height
        ):
            raise InputError(
                f"the image is {width}x{height}, but {frames.names[row]} is {sizes[row, 0]}x{sizes[row, 1]}: "
                f"all images of {LISTS[Role(str(role))]} must have one aspect ratio; crop them to it, or "
                "import images of different shape separately",
                path=frames.files[k],
            )
