"""Guided matching of a frame with the map: map points are searched for where a first pose projects them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import binom

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.matching.putative import MatchOptions, unit_descriptors
from spn_data.registration.frozen_map import FrozenMap

SEARCH_PX = 12.0  # radius of the search around a projected point
AGREE_PX = 4.0  # a point found within this is where the pose puts it
_VIEWS = 3  # descriptors tried per point: those seen from the most similar direction and distance
_MAX_ANGLE_DEG = 70.0  # between the frame's view of a point and the map frame's
_MAX_MAP_FRAMES = 48
_MAX_RATIO = 0.9  # descriptor distance of the match over the smallest one elsewhere in the image
_CELL_PX = 16.0  # matches in one cell are one witness


@dataclass(frozen=True, eq=False)
class MapSearch:
    """Map points found in a frame near their projections.

    Attributes
    ----------
    matches : ndarray, shape (M, 2)
        Feature and map point row.
    away_px : ndarray, shape (M,)
        Distance of the feature from the projected point.
    pixels : ndarray, shape (M, 2)
        Of the features.
    """

    matches: np.ndarray
    away_px: np.ndarray
    pixels: np.ndarray

    def witnesses(self) -> tuple[int, int]:
        """Return in how many cells of the image a point was found, and in how many where it should be."""
        cells = np.floor(self.pixels / _CELL_PX)
        order = np.argsort(self.away_px, kind="stable")
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        cell = cell.ravel()[order]
        agree = [np.median(self.away_px[order][cell == k]) <= AGREE_PX for k in np.unique(cell)]
        return len(agree), int(sum(agree))

    def chance(self) -> float:
        """Return the probability that as many witnesses agree if the pose is wrong.

        Features that only resemble a point lie anywhere in the search radius, a share of
        (AGREE_PX / SEARCH_PX)^2 of them near its centre. Those of a true pose pile up there.
        """
        found, agree = self.witnesses()
        return float(binom.sf(agree - 1, found, (AGREE_PX / SEARCH_PX) ** 2))


def search_map(
    keypoints: np.ndarray,
    descriptors: np.ndarray,
    pose: Poses,
    camera: Camera,
    frozen: FrozenMap,
    options: MatchOptions,
) -> MapSearch:
    """Search a frame for the map points that its pose puts into it.

    A point matches the feature within `SEARCH_PX` of its projection whose descriptor is nearest to the
    point's, if none elsewhere in the image is about as near. Of a point's descriptors, those from the most
    similar views are compared.

    Parameters
    ----------
    keypoints : ndarray, shape (K, 2)
        Positions of the frame's features in pixels.
    descriptors : ndarray of uint8, shape (K, 128)
        Their RootSIFT descriptors.
    pose : Poses
        One pose, in the map's frame.
    camera : Camera
    frozen : FrozenMap
    options : MatchOptions
        Supplies `max_distance`.

    Returns
    -------
    MapSearch
        At most one match per feature and per point.
    """
    if not len(keypoints):
        return MapSearch(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros((0, 2)))
    projected = _projections(frozen.points.xyz, pose, camera)
    image, point = _nearest_views(frozen, pose, np.isfinite(projected[:, 0]))
    mine, features = unit_descriptors(descriptors), cKDTree(keypoints)
    none = np.zeros(0, np.int64)
    feature, found, distance_sq = [none], [none], [np.zeros(0)]
    for k in np.unique(image).tolist():
        view = frozen.frame(frozen.scene.names[k])
        kept = np.isin(view.point_rows, point[image == k])
        rows = view.point_rows[kept]
        similarity = unit_descriptors(view.descriptors[kept]) @ mine.T
        near = features.query_ball_point(projected[rows], SEARCH_PX)
        row = np.repeat(np.arange(len(rows)), [len(some) for some in near])
        column = np.fromiter(chain.from_iterable(near), np.int64, len(row))
        inside = similarity[row, column]
        similarity[row, column] = -1.0
        outside_sq = 2 - 2 * similarity.max(axis=1, initial=-1.0)[row]
        inside_sq = 2 - 2 * inside
        good = inside_sq < np.minimum(options.max_distance**2, _MAX_RATIO**2 * outside_sq)
        feature.append(column[good])
        found.append(rows[row[good]])
        distance_sq.append(inside_sq[good])
    matches = np.column_stack([np.concatenate(feature), np.concatenate(found)])
    order = np.argsort(np.concatenate(distance_sq), kind="stable")
    for side in (1, 0):  # the nearest descriptor of each point, then of each feature
        _, first = np.unique(matches[order, side], return_index=True)
        order = order[np.sort(first)]
    matches = matches[order]
    pixels = keypoints[matches[:, 0]]
    away_px = np.linalg.norm(projected[matches[:, 1]] - pixels, axis=1)
    return MapSearch(matches, away_px, pixels)


def _projections(xyz: np.ndarray, pose: Poses, camera: Camera) -> np.ndarray:
    """Return where points (P, 3) are in the image; NaN outside of it."""
    in_camera = pose.to_camera(xyz)
    projected = np.full((len(xyz), 2), np.nan)
    ahead = np.flatnonzero(in_camera[:, 2] > 0)
    pixels = camera.project(in_camera[ahead])
    inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    ahead, pixels = ahead[inside], pixels[inside]
    # Far outside the image, the distortion may fold back into it.
    rays = in_camera[ahead, :2] / in_camera[ahead, 2:]
    same = np.abs(camera.unproject(pixels) - rays).max(axis=1, initial=0.0) < 1e-3
    projected[ahead[same]] = pixels[same]
    return projected


def _nearest_views(
    frozen: FrozenMap, pose: Poses, in_view: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return map frame (V,) and point row (V,) of the views that are most like those from a pose."""
    seen = frozen.observations
    kept = np.flatnonzero(in_view[seen.point_idx])
    image, point = seen.image_idx[kept], seen.point_idx[kept]
    to_map = frozen.scene.poses.centers[image] - frozen.points.xyz[point]
    to_here = pose.centers[0] - frozen.points.xyz[point]
    far, here = (np.maximum(np.linalg.norm(d, axis=1), 1e-12) for d in (to_map, to_here))
    cosine = np.clip((to_map * to_here).sum(axis=1) / (far * here), -1, 1)
    angle_deg = np.rad2deg(np.arccos(cosine))
    unlike = angle_deg / 30 + np.abs(np.log2(far / here))
    order = np.lexsort((unlike, point))
    order = order[angle_deg[order] <= _MAX_ANGLE_DEG]
    _, first, count = np.unique(point[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, count)
    chosen = order[rank < _VIEWS]
    image, point = image[chosen], point[chosen]
    frames, uses = np.unique(image, return_counts=True)
    used = np.isin(image, frames[np.argsort(-uses, kind="stable")[:_MAX_MAP_FRAMES]])
    return image[used], point[used]
