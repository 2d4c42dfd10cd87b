"""COLMAP's database: cameras and images first, then features and verified pairs in any order.

Each write is committed at once, so that a killed run loses nothing it has written.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.verify import VerifiedPair, native_camera
from spn_data.errors import FormatError, StageError
from spn_data.geometry.initial_lens import InitialLens
from spn_data.matching.features import Features


@dataclass(frozen=True)
class DatabaseImage:
    """Row of an image.

    Attributes
    ----------
    name : str
        COLMAP's image name: the path relative to the image folder.
    camera : str
        Key of the image's camera.
    """

    name: str
    camera: str


class MapDatabase:
    """Open COLMAP database whose image ids follow the order in which the images were added.

    Attributes
    ----------
    ids : dict of str to int
        COLMAP's image id by image name.
    """

    def __init__(self, native: pycolmap.Database, path: Path):
        self._native = native
        self._path = path
        self.ids = {image.name: image.image_id for image in native.read_all_images()}

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[Self]:
        """Open a database, or create it.

        Parameters
        ----------
        path : Path
            Database file.

        Yields
        ------
        MapDatabase
            Closed when the context exits.

        Raises
        ------
        FormatError
            If the file is not a COLMAP database or is damaged.
        StageError
            If the disk is full.
        """
        _check_disk_space(path, 0)
        try:
            native = pycolmap.Database.open(path)
            opened = cls(native, path)
        except (RuntimeError, ValueError) as error:
            raise FormatError(
                f"{path}: not a COLMAP database, or damaged; delete it and run the command again"
            ) from error
        try:
            yield opened
        finally:
            native.close()

    def add_images(
        self,
        images: Sequence[DatabaseImage],
        lenses: Mapping[str, InitialLens],
    ) -> None:
        """Insert the images that the database does not contain yet.

        Parameters
        ----------
        images : sequence of DatabaseImage
        lenses : mapping of str to InitialLens
            By camera key. One camera is inserted per key.
        """
        camera_ids = {
            image.camera: self._native.read_image_with_name(image.name).camera_id
            for image in images
            if image.name in self.ids
        }
        with pycolmap.DatabaseTransaction(self._native):
            for image in images:
                if image.name in self.ids:
                    continue
                if image.camera not in camera_ids:
                    camera_ids[image.camera] = self._add_camera(lenses[image.camera])
                self.ids[image.name] = self._add_image(image.name, camera_ids[image.camera])

    def _add_camera(self, lens: InitialLens) -> int:
        camera_id = self._native.num_cameras() + 1
        self._write_camera(
            native_camera(lens.camera, camera_id=camera_id, focal_is_known=lens.focal_is_known)
        )
        return camera_id

    def _write_camera(self, native: pycolmap.Camera) -> None:
        self._native.write_camera(native, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=native.camera_id)
        rig.add_ref_sensor(native.sensor_id)
        self._native.write_rig(rig, use_rig_id=True)

    def _add_image(self, name: str, camera_id: int) -> int:
        image_id = self._native.num_images() + 1
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        self._native.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        self._native.write_frame(frame, use_frame_id=True)
        return image_id

    def cameras_of(self, keys: Mapping[str, str]) -> dict[str, int]:
        """Return COLMAP's id of each camera, given the keys of the cameras by image name."""
        return {
            key: int(self._native.read_image_with_name(name).camera_id)
            for key, name in {key: name for name, key in keys.items()}.items()
        }

    def has_features(self, name: str) -> bool:
        """Return whether features of an image are stored."""
        # Descriptors are written after the keypoints.
        return bool(self._native.exists_descriptors(self.ids[name]))

    def write_features(self, name: str, features: Features) -> None:
        """Store the features of an image.

        Parameters
        ----------
        name : str
            Image name.
        features : Features

        Raises
        ------
        ValueError
            If the image already has features.
        StageError
            If the disk is full.
        """
        image_id = self.ids[name]
        if self._native.exists_keypoints(image_id):
            raise ValueError(f"{name} already has features")
        descriptors = pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.SIFT, data=features.descriptors
        )
        _check_disk_space(self._path, features.keypoints.nbytes + features.descriptors.nbytes)
        with pycolmap.DatabaseTransaction(self._native):
            self._native.write_keypoints(image_id, features.keypoints)
            self._native.write_descriptors(image_id, descriptors)

    def read_features(self, name: str) -> Features:
        """Read the keypoints and descriptors of an image."""
        image_id = self.ids[name]
        return Features(
            self.read_keypoints(name),
            np.asarray(self._native.read_descriptors(image_id).data, np.uint8).reshape(-1, 128),
        )

    def read_keypoints(self, name: str) -> np.ndarray:
        """Read the keypoints of an image, without descriptors."""
        keypoints = np.asarray(self._native.read_keypoints(self.ids[name]), np.float32)
        return keypoints if keypoints.size else np.zeros((0, 4), np.float32)

    def num_keypoints(self, name: str) -> int:
        """Return the number of keypoints of an image."""
        return int(self._native.num_keypoints_for_image(self.ids[name]))

    def has_pair(self, pair: tuple[int, int]) -> bool:
        """Return whether a pair of image ids has been matched, verified or not."""
        return bool(self._native.exists_two_view_geometry(*pair))

    def write_pair(self, pair: VerifiedPair) -> None:
        """Store putative matches and the verified two-view geometry of a pair.

        A pair that failed verification gets a row too, so that it is not matched again.

        Parameters
        ----------
        pair : VerifiedPair

        Raises
        ------
        StageError
            If the disk is full.
        """
        geometry = pycolmap.TwoViewGeometry(
            config=pycolmap.TwoViewGeometryConfiguration(pair.config),
            E=pair.e,
            F=pair.f,
            H=pair.h,
            inlier_matches=pair.inliers,
        )
        _check_disk_space(self._path, pair.matches.nbytes + pair.inliers.nbytes)
        with pycolmap.DatabaseTransaction(self._native):
            self._native.write_matches(*pair.image_ids, pair.matches)
            self._native.write_two_view_geometry(*pair.image_ids, geometry)

    def read_inliers(self, first: str, second: str) -> np.ndarray:
        """Read the verified matches of two images.

        Parameters
        ----------
        first, second : str
            Image names.

        Returns
        -------
        ndarray, shape (K, 2), int64
            Feature indices in the first and second image; empty if the pair has no verified matches.
        """
        pair = (self.ids[first], self.ids[second])
        if not self._native.exists_two_view_geometry(*pair):
            return np.zeros((0, 2), np.int64)
        matches = self._native.read_two_view_geometry(*pair).inlier_matches
        return np.asarray(matches, dtype=np.int64).reshape(-1, 2)

    def write_thinned(self, target: Path, features: int) -> None:
        """Write a database that keeps only the features of each image with most verified matches.

        These features suffice to connect most pairs. Repetitive structure such as windows matches in only one
        wrong pair or another, so wrong pairs lose more matches than right ones. Images with few matches keep
        all of them.

        Parameters
        ----------
        target : Path
            File to write; an existing file is replaced. Images and cameras are the same as in this database;
            features are renumbered in the same order.
        features : int
            Number of features to keep per image.

        Raises
        ------
        StageError
            If the disk is full.
        """
        source = self._native
        pairs = [(self.ids[a], self.ids[b], n) for (a, b), n in self.verified_pairs().items()]
        matched = {
            image_id: np.zeros(source.num_keypoints_for_image(image_id), np.int64)
            for image_id in self.ids.values()
        }
        for first, second, _ in pairs:
            matches = source.read_two_view_geometry(first, second).inlier_matches
            matched[first][matches[:, 0]] += 1
            matched[second][matches[:, 1]] += 1
        kept = {  # of features with equally many matches, the stronger ones
            image_id: np.sort(np.argsort(-count, kind="stable")[:features])
            for image_id, count in matched.items()
        }
        numbers = {image_id: np.full(len(count), -1) for image_id, count in matched.items()}
        for image_id, rows in kept.items():
            numbers[image_id][rows] = np.arange(len(rows))
        size = sum(8 * n for *_, n in pairs) + sum(16 * len(rows) for rows in kept.values())
        with self._write_images(target, size) as thin:
            for image_id, rows in kept.items():
                thin.write_keypoints(image_id, source.read_keypoints(image_id)[rows])
            for first, second, _ in pairs:
                geometry = source.read_two_view_geometry(first, second)
                one, other = geometry.inlier_matches.T
                matches = np.stack([numbers[first][one], numbers[second][other]], axis=1)
                both = (matches >= 0).all(axis=1)
                geometry.inlier_matches = matches[both].astype(np.uint32)
                thin.write_two_view_geometry(first, second, geometry)

    def write_without(self, target: Path, names: Sequence[str]) -> None:
        """Write a copy in which some images have no features and no pairs.

        Parameters
        ----------
        target : Path
            File to write; an existing file is replaced.
        names : sequence of str
            Images to clear.

        Raises
        ------
        StageError
            If the disk is full.
        """
        cleared = {self.ids[name] for name in names}
        self._write_copy(target, set(self.ids.values()) - cleared, cleared.isdisjoint)

    def write_with_pairs(self, target: Path, pairs: Collection[tuple[str, str]]) -> None:
        """Write a copy with all features and only some pairs.

        Parameters
        ----------
        target : Path
            File to write; an existing file is replaced.
        pairs : collection of (str, str)
            Pairs of image names to keep, in the order of `verified_pairs`.

        Raises
        ------
        StageError
            If the disk is full.
        """
        kept = {(self.ids[first], self.ids[second]) for first, second in pairs}
        self._write_copy(target, set(self.ids.values()), kept.__contains__)

    def _write_copy(
        self, target: Path, images: set[int], keeps: Callable[[tuple[int, int]], bool]
    ) -> None:
        """Write a copy with the features of some images and the pairs of ids that `keeps` accepts."""
        source = self._native
        with self._write_images(target, self._path.stat().st_size) as copy:
            for image_id in images:
                copy.write_keypoints(image_id, source.read_keypoints(image_id))
                copy.write_descriptors(image_id, source.read_descriptors(image_id))
            for pair_id in source.read_num_matches()[0]:
                pair = pycolmap.pair_id_to_image_pair(pair_id)
                if keeps(pair):
                    copy.write_matches(*pair, source.read_matches(*pair))
                    copy.write_two_view_geometry(*pair, source.read_two_view_geometry(*pair))

    @contextmanager
    def _write_images(self, target: Path, size: int) -> Iterator[pycolmap.Database]:
        """Create a database with the same cameras and images, to which about `size` bytes are added."""
        _check_disk_space(target, size)
        part = target.with_name(target.name + ".part")
        part.unlink(missing_ok=True)
        with (
            MapDatabase.open(part) as made,
            pycolmap.DatabaseTransaction(made._native),
        ):
            for camera in self._native.read_all_cameras():
                made._write_camera(camera)
            for name, image_id in sorted(self.ids.items(), key=lambda item: item[1]):
                made._add_image(name, self._native.read_image(image_id).camera_id)
            yield made._native
        part.replace(target)

    def num_pairs(self) -> int:
        """Return the number of pairs that were matched, verified or not."""
        return int(self._native.num_matched_image_pairs())

    def verified_pairs(self) -> dict[tuple[str, str], int]:
        """Return the number of inlier matches of each verified pair of image names."""
        names = {image_id: name for name, image_id in self.ids.items()}
        counts: dict[tuple[str, str], int] = {}
        for pair_id, inliers in zip(
            *self._native.read_two_view_geometry_num_inliers(), strict=True
        ):
            if inliers > 0:
                first, second = pycolmap.pair_id_to_image_pair(pair_id)
                counts[names[first], names[second]] = int(inliers)
        return counts


_RESERVE_BYTES = 2_000_000  # for indices, and for merging the journal into the database


def _check_disk_space(path: Path, size: int) -> None:
    """Raise StageError if the disk is full.

    COLMAP would abort the process when a transaction fails.
    """
    free = shutil.disk_usage(path.parent).free
    if free < 2 * size + _RESERVE_BYTES:
        raise StageError(
            f"{path}: the disk is full ({free / 1e6:.1f} MB free). Finished work is kept: free some space "
            "and run the same command again to continue"
        )
