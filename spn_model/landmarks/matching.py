"""Matching of the features of an image with the landmarks that a supposed pose sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import to_camera
from spn_data.matching.features import Features
from spn_data.matching.putative import unit_descriptors
from spn_model.landmarks.landmark_map import LandmarkMap
from spn_model.landmarks.solver import Sightings

_MAX_ANGLE_DEG = 65.0  # between the view of a landmark and that of its descriptor
_MIN_DEPTH_M = 0.1
_MIN_SCALE = 0.6  # scale in working pixels below which a keypoint is not detected
_MAX_LANDMARKS = 2500  # compared with the image; the ones seen most alike
_MAX_RATIO = 0.88  # distance of the nearest landmark over that of the second nearest
_MIN_SIMILARITY = 1 - 0.8**2 / 2  # of unit descriptors; a distance of at most 0.8
STRONGEST = 400  # features that are compared with all landmarks
_BLOCK = 1024  # landmarks compared at once, so that their similarities fit into the CPU cache
_SIZE_PX = 12.0  # scale of keypoints with twice the standard deviation of small ones


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """Features of an image in the pinhole of its camera.

    Attributes
    ----------
    at : ndarray, shape (K, 2)
        Positions relative to the principal point, without distortion, in pixels of `focal_px`.
    scales : ndarray, shape (K,)
        Of the keypoints, in the same pixels.
    units : ndarray of float32, shape (K, 128)
        Descriptors of length one.
    focal_px : float
        Of the camera reduced to the width that features are detected at.
    half_view : ndarray, shape (2,)
        Tangents of half the field of view, with distortion.
    """

    at: np.ndarray
    scales: np.ndarray
    units: np.ndarray
    focal_px: float
    half_view: np.ndarray

    def __len__(self) -> int:
        return len(self.at)

    @classmethod
    def of(cls, features: Features, camera: Camera, width_px: int) -> ImageFeatures:
        """Return the features of an image taken with a camera; keypoints are in its pixels."""
        reduction = min(1.0, width_px / max(camera.width, camera.height))
        focal_px = camera.focal_px[0] * reduction
        keypoints = features.keypoints.astype(np.float64)
        corners = [[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]]
        return cls(
            at=camera.unproject(keypoints[:, :2]) * focal_px,
            scales=keypoints[:, 2] * reduction,
            units=unit_descriptors(features.descriptors),
            focal_px=focal_px,
            half_view=np.abs(camera.unproject(np.array(corners, np.float64))).max(axis=0),
        )


@dataclass(frozen=True, eq=False)
class Expected:
    """Landmarks that a pose should see, with the descriptors that are most like its view of them.

    Attributes
    ----------
    rows : ndarray, shape (D,)
        Rows of descriptors, ascending.
    landmarks : ndarray, shape (L,)
        Their landmarks.
    owner : ndarray, shape (D,)
        For each of `rows`, the row in `landmarks`.
    at : ndarray, shape (L, 2)
        Projections, in pixels relative to the principal point.
    """

    rows: np.ndarray
    landmarks: np.ndarray
    owner: np.ndarray
    at: np.ndarray

    def seen_from(
        self, landmarks: LandmarkMap, center: np.ndarray, rotation: np.ndarray, focal_px: float
    ) -> Expected:
        """Return the same landmarks as a pose close to the first one sees them."""
        return replace(
            self, at=projected(landmarks.xyz[self.landmarks], center, rotation, focal_px)
        )


def expected(
    landmarks: LandmarkMap,
    center: np.ndarray,
    rotation: np.ndarray,
    focal_px: float,
    half_view: np.ndarray,
    *,
    margin: float = 1.0,
) -> Expected:
    """Return the landmarks that a camera at a pose should see.

    Parameters
    ----------
    landmarks : LandmarkMap
    center : ndarray, shape (3,)
    rotation : ndarray, shape (3, 3)
    focal_px : float
        At the width that features are detected at.
    half_view : ndarray, shape (2,)
        Tangents of half the field of view.
    margin : float
        Factor on the field of view, for a pose that is uncertain.

    Returns
    -------
    Expected
        At most 2,500 descriptors, those from the most similar direction and distance.
    """
    x = to_camera(landmarks.xyz, center, rotation)
    z = x[:, 2]
    ahead = z > _MIN_DEPTH_M
    inside = ahead & (
        np.abs(x[:, :2]) < (margin * half_view) * np.where(ahead, z, 1.0)[:, None]
    ).all(axis=1)
    rows = np.flatnonzero(inside[landmarks.landmark])
    owner = landmarks.landmark[rows]
    towards = center - landmarks.xyz[owner]
    far = np.linalg.norm(towards, axis=1)
    cosine = (towards * landmarks.directions[rows]).sum(axis=1) / np.maximum(far, 1e-9)
    angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    scale = landmarks.sizes_m[rows] * focal_px / np.maximum(z[owner], 1e-3)
    unlike = angle_deg / 30 + np.abs(np.log2(far / landmarks.distances_m[rows]))
    kept = np.flatnonzero((angle_deg < _MAX_ANGLE_DEG) & (scale > _MIN_SCALE))
    if len(kept) > _MAX_LANDMARKS:
        kept = np.sort(kept[np.argpartition(unlike[kept], _MAX_LANDMARKS)[:_MAX_LANDMARKS]])
    rows, owner = rows[kept], owner[kept]
    own, inverse = np.unique(owner, return_inverse=True)
    return Expected(rows, own, inverse.ravel(), x[own, :2] / z[own, None] * focal_px)


def projected(
    xyz: np.ndarray, center: np.ndarray, rotation: np.ndarray, focal_px: float
) -> np.ndarray:
    """Return the projections (N, 2) of points relative to the principal point; infinity behind the camera."""
    x = to_camera(xyz, center, rotation)
    z = np.where(x[:, 2:] > _MIN_DEPTH_M, x[:, 2:], np.nan)
    return np.nan_to_num(x[:, :2] / z * focal_px, nan=np.inf)


def match(
    features: ImageFeatures,
    landmarks: LandmarkMap,
    candidates: Expected,
    radius_px: float | None = None,
) -> Sightings:
    """Match features with expected landmarks in much of the image: mutual nearest, and no other as near.

    Parameters
    ----------
    features : ImageFeatures
    landmarks : LandmarkMap
    candidates : Expected
    radius_px : float, optional
        Largest distance of a feature from the projection of its landmark along each axis.

    Returns
    -------
    Sightings
        At most one for each landmark and each feature.
    """
    if not len(features) or not len(candidates.rows):
        return _sightings(features, landmarks, *np.zeros((2, 0), np.int64))
    first = np.searchsorted(candidates.owner, np.arange(len(candidates.landmarks)))
    # Of each feature and landmark, that of the descriptor most alike.
    similarity = np.maximum.reduceat(
        features.units @ landmarks.units[candidates.rows].T, first, axis=1
    )
    if radius_px is not None:
        for axis in range(2):
            off_px = np.abs(features.at[:, None, axis] - candidates.at[:, axis])
            similarity[off_px >= radius_px] = 0
    mutual = similarity.argmax(axis=0)
    every, nearest = np.arange(len(features)), similarity.argmax(axis=1)
    near = similarity[every, nearest]
    similarity[every, nearest] = 0
    second = similarity.max(axis=1)
    second[second <= _MIN_SIMILARITY] = 0  # an unrelated descriptor
    feature = np.flatnonzero(
        (mutual[nearest] == every) & (near > _MIN_SIMILARITY) & _is_distinct(near, second)
    )
    return _sightings(features, landmarks, candidates.landmarks[nearest[feature]], feature)


def _is_distinct(near: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return whether a similarity is enough above the second one: the ratio of distances."""
    found: np.ndarray = 2 - 2 * near < _MAX_RATIO**2 * (2 - 2 * second)
    return found


def match_near(
    features: ImageFeatures, landmarks: LandmarkMap, candidates: Expected, radius_px: float
) -> Sightings:
    """Match features with expected landmarks close to their projections: as `match`, fast for small radii.

    Parameters
    ----------
    features : ImageFeatures
    landmarks : LandmarkMap
    candidates : Expected
    radius_px : float
        Largest distance of a feature from the projection of its landmark along each axis.

    Returns
    -------
    Sightings
        At most one for each landmark and each feature.
    """
    at = candidates.at[candidates.owner]
    order = np.argsort(features.at[:, 0], kind="stable")
    x = features.at[order, 0]
    first = np.searchsorted(x, at[:, 0] - radius_px)
    count = np.searchsorted(x, at[:, 0] + radius_px) - first
    column = np.repeat(np.arange(len(at)), count)
    begin = np.repeat(first - (np.cumsum(count) - count), count)
    row = order[begin + np.arange(len(column))]
    near = np.abs(features.at[row, 1] - at[column, 1]) < radius_px
    row, column = row[near], column[near]
    similarity = np.einsum(
        "nk,nk->n", features.units[row], landmarks.units[candidates.rows[column]]
    )
    alike = similarity > _MIN_SIMILARITY
    return _best(features, landmarks, candidates, row[alike], column[alike], similarity[alike])


def _best(
    features: ImageFeatures,
    landmarks: LandmarkMap,
    candidates: Expected,
    row: np.ndarray,
    column: np.ndarray,
    similarity: np.ndarray,
) -> Sightings:
    """Choose among pairs of a feature and a descriptor (P,): mutual nearest that pass the ratio test."""
    order = np.argsort(-similarity, kind="stable")
    row, owner, similarity = row[order], candidates.owner[column[order]], similarity[order]
    feature, first = np.unique(row, return_index=True)
    _, of_landmark = np.unique(owner, return_index=True)
    is_first = np.zeros(len(row), bool)
    is_first[of_landmark] = True
    # Of each feature the nearest pair with another landmark than that of the nearest.
    nearest = np.zeros(len(features), np.int64)
    nearest[feature] = owner[first]
    others = np.flatnonzero(owner != nearest[row])
    with_other, where = np.unique(row[others], return_index=True)
    second = np.zeros(len(features))  # similarity of an unrelated descriptor
    second[with_other] = similarity[others[where]]
    near = similarity[first]
    good = is_first[first] & _is_distinct(near, second[feature])
    return _sightings(features, landmarks, candidates.landmarks[owner[first[good]]], feature[good])


def match_all(
    features: ImageFeatures, landmarks: LandmarkMap, rows: slice = slice(STRONGEST)
) -> Sightings:
    """Match some features, the strongest first, with all landmarks, by descriptors in a reduced space."""
    begin, end, _ = rows.indices(len(features))
    queries = features.units[begin:end] @ landmarks.basis
    # Squared distances, less what all distances of a feature have in common, in one product.
    sides = np.column_stack([-2 * queries, np.ones(len(queries), np.float32)])
    count, every = len(queries), np.arange(len(queries))
    nearest = np.zeros(count, np.int64)
    first, second = np.full((2, count), np.inf, np.float32)
    # New memory for each block would cost as much again.
    room = np.empty(count * _BLOCK, np.float32)
    for start in range(0, len(landmarks), _BLOCK):
        block = landmarks.reduced[:, start : start + _BLOCK]
        distance_sq = room[: count * block.shape[1]].reshape(count, block.shape[1])
        np.matmul(sides, block, out=distance_sq)
        best = distance_sq.argmin(axis=1)
        found = distance_sq[every, best]
        distance_sq[every, best] = np.inf
        second = np.minimum(second, np.minimum(distance_sq.min(axis=1), np.maximum(first, found)))
        nearer = found < first
        nearest[nearer], first[nearer] = start + best[nearer], found[nearer]
    own_sq = (queries**2).sum(axis=1)
    feature = np.flatnonzero(first + own_sq < _MAX_RATIO**2 * (second + own_sq))
    return _sightings(features, landmarks, nearest[feature], begin + feature)


def _sightings(
    features: ImageFeatures, landmarks: LandmarkMap, rows: np.ndarray, feature: np.ndarray
) -> Sightings:
    noise = landmarks.facts.noise_px * np.sqrt(1 + 3 * (features.scales[feature] / _SIZE_PX) ** 2)
    return Sightings(
        landmarks=rows,
        features=feature,
        xyz=landmarks.xyz[rows],
        covariance=landmarks.covariance[rows],
        at=features.at[feature],
        sigma_px=noise,
        focal_px=features.focal_px,
    )
