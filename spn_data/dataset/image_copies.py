"""Checks of the images of a data set: copies of training images among test images, images without texture."""

from __future__ import annotations

from hashlib import blake2b

import cv2
import numpy as np

from spn_data.dataset.hdf5_schema import Role
from spn_data.geometry.image_texture import missing_texture

_THUMBNAIL = (32, 24)
# Mean difference in grey levels of reduced images. JPEG of quality 50 changes them by 0.3 to 0.9 levels;
# photos and video frames of different places differ by 9 or more.
_SAME_LEVELS = 1.5
_BLOCK = 256


class ImageChecks:
    """Collects what images of several groups have in common, one image after the other.

    Attributes
    ----------
    bare : list of str
        Names of the images without texture.
    repeated : list of tuple of str
        Names of images of one role, each with the earlier one that has the same pixels.
    """

    def __init__(self) -> None:
        self.bare: list[str] = []
        self.repeated: list[tuple[str, str]] = []
        self._seen: dict[bytes, tuple[str, Role]] = {}
        self._names: list[str] = []
        self._roles: list[Role] = []
        self._thumbnails: list[np.ndarray] = []

    def add(self, name: str, role: Role, image: np.ndarray) -> str:
        """Check one image.

        Parameters
        ----------
        name : str
            Name of the frame.
        role : Role
            Role of its group.
        image : ndarray of uint8, shape (H, W, 3)
            The image.

        Returns
        -------
        str
            Name of an earlier image of another role with the same pixels, or "". Images without texture, such
            as black ones, are not compared.
        """
        if missing_texture(image):
            self.bare.append(name)
            return ""
        gray = cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA).mean(axis=2)
        self._names.append(name)
        self._roles.append(role)
        self._thumbnails.append(gray.ravel().astype(np.float32))
        digest = blake2b(repr(image.shape).encode(), digest_size=16)
        digest.update(image.tobytes())
        other, other_role = self._seen.setdefault(digest.digest(), (name, role))
        if other != name and other_role is not role:
            return other
        if other != name:
            self.repeated.append((name, other))
        return ""

    def lookalikes(self) -> list[tuple[str, str]]:
        """Return each test or validation image that looks the same as a training image, with that image.

        They differ by less than 1.5 grey levels on average at 32x24 pixels: one is compressed again, or the
        camera did not move.
        """
        if not self._names:
            return []
        roles = np.array([role.value for role in self._roles])
        trained = np.flatnonzero(roles == Role.TRAIN.value)
        if not len(trained):
            return []
        thumbnails = np.stack(self._thumbnails)
        found = []
        for k in np.flatnonzero(roles != Role.TRAIN.value):
            for first in range(0, len(trained), _BLOCK):
                rows = trained[first : first + _BLOCK]
                apart = np.abs(thumbnails[rows] - thumbnails[k]).mean(axis=1)
                if apart.min() < _SAME_LEVELS:
                    found.append((self._names[k], self._names[rows[int(apart.argmin())]]))
                    break
        return found
