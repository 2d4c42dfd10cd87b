"""Measurements of map points in map frames, with descriptors, from which landmarks of a bundle are chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import DATABASE, FRAMES, FRAMES_TABLE, GEO, MODEL, SPLIT
from spn_data.capture.frames import read_frames
from spn_data.colmap.map_features import MapFeatures
from spn_data.colmap.model import read_map_with_keypoints
from spn_data.geometry.pose import Poses
from spn_data.labels.map_hash import map_hash


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkSource:
    """M measurements of P points in F frames of a georeferenced map.

    Attributes
    ----------
    fingerprint : str
        Of the stage 3-geo, as data sets made from it state it.
    map_hash : str
        Hash over the files of the map.
    xyz : ndarray, shape (P, 3)
        Positions in the world, metres.
    names : tuple of str
        Of the frames.
    poses : Poses
        Of the frames.
    flights : tuple of str
        Sequences of the frames.
    gimbal_deg : ndarray, shape (F, 3)
        Heading, pitch and roll that the telemetry states for each frame; NaN if it states none.
    focal_px : ndarray, shape (F,)
        Horizontal focal lengths.
    sizes : ndarray, shape (F, 2)
        Width and height of the images.
    frame, point : ndarray of int, shape (M,)
        Rows of frame and point.
    pixels : ndarray, shape (M, 2)
        Measured.
    scales : ndarray, shape (M,)
        Of the keypoints, in pixels.
    descriptors : ndarray of uint8, shape (M, 128)
        RootSIFT.
    """

    fingerprint: str
    map_hash: str
    xyz: np.ndarray
    names: tuple[str, ...]
    poses: Poses
    flights: tuple[str, ...]
    gimbal_deg: np.ndarray
    focal_px: np.ndarray
    sizes: np.ndarray
    frame: np.ndarray
    point: np.ndarray
    pixels: np.ndarray
    scales: np.ndarray
    descriptors: np.ndarray


def read_landmark_source(area: Area) -> LandmarkSource:
    """Read the georeferenced map of an area with the descriptors of its features.

    Parameters
    ----------
    area : Area

    Returns
    -------
    LandmarkSource

    Raises
    ------
    StageError
        If the area has no georeferenced map, or a stale one.
    FormatError
        If model or database are damaged.
    """
    fingerprint, geo = area.upstream_of(SPLIT)[GEO], area.folder(GEO)
    scene, seen, points, point_ids = read_map_with_keypoints(geo)
    descriptors, scales = [], []
    with MapFeatures.open(area.folder(MODEL) / DATABASE) as opened:
        for name in scene.names:
            is_point = point_ids[name] >= 0
            descriptors.append(opened.descriptors(name)[is_point])
            scales.append(opened.scales(name)[is_point])
    table = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    rows = {str(name): row for row, name in enumerate(table.names)}
    listed = np.array([rows[str(name)] for name in scene.names])
    cameras = [scene.cameras[int(number)] for number in scene.camera_ids]
    return LandmarkSource(
        fingerprint=fingerprint,
        map_hash=map_hash(geo),
        xyz=points.xyz,
        names=tuple(str(name) for name in scene.names),
        poses=scene.poses,
        flights=tuple(str(name) for name in table.sequences[listed]),
        gimbal_deg=table.gimbal_deg[listed],
        focal_px=np.array([camera.focal_px[0] for camera in cameras]),
        sizes=np.array([(camera.width, camera.height) for camera in cameras]),
        frame=seen.image_idx,
        point=seen.point_idx,
        pixels=seen.pixels,
        scales=np.concatenate(scales),
        descriptors=np.concatenate(descriptors),
    )
