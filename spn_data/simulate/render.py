"""Anti-aliased rendering of textured planar faces through a distorted lens, exact to a few 0.01 px.

A plane seen through a pinhole is linear in the ray: with ``X = origin + s*u_edge + t*v_edge``, the vector
``(s, t, 1) / depth`` is a matrix times the ray ``(x, y, 1)``. Visibility, face edges and texture
coordinates all follow from that matrix, and lens distortion only enters the rays, which are computed once
per camera. The image is processed in tiles: if one face covers a tile (most of them), it is sampled
at once; otherwise each sample takes the nearest face. Each pixel is the mean of four samples on a rotated
grid, each interpolated bilinearly in a mip level chosen by the tile's footprint on the texture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from spn_data.geometry.camera import OPENCV_FROM_COLMAP, Camera
from spn_data.simulate.faces import MAX_CORNERS, Body, Face, Texture
from spn_data.simulate.light import GAIN_UNIT, Sunlight, cast_shadows, normals
from spn_data.simulate.rays import TILE_PX, RayGrid

BAND_PX = 8  # rows that share one pose under a rolling shutter
# Four distinct offsets in x and in y, so that edges of any direction get five shades of coverage.
# They are point-symmetric (first and last, second and third), so that their mean is the pixel centre.
SAMPLE_OFFSETS_PX = np.array([[-3.0, -1.0], [1.0, -3.0], [-1.0, 3.0], [3.0, 1.0]]) / 8
HAZE_RGB = (208, 214, 220)  # colour of rays that hit no face
_EDGE_TOLERANCE = 1e-7  # prevents cracks between adjacent faces due to rounding


class SceneRenderer:
    """Renderer of a set of faces for one camera; each image depends only on the poses."""

    def __init__(self, faces: Sequence[Face], textures: Mapping[str, Texture], camera: Camera):
        mirrors = [face.mirrored for face in faces if face.mirrored is not None]
        table = [*faces, *mirrors]
        self._camera = camera
        self._visible_faces = len(faces)
        self._textures = [textures[face.texture] for face in table]
        self._origins = np.stack([face.origin for face in table]).astype(np.float64)
        self._axes = np.stack([np.stack([face.u_edge, face.v_edge]) for face in table])
        self._at_infinity = np.array([face.at_infinity for face in table])
        # Padding edges only require that the face is in front of the eye.
        self._edges = np.tile(np.array([0.0, 0.0, 1.0]), (len(faces), MAX_CORNERS, 1))
        self._edge_counts = []
        self._mirror_idx = np.full(len(table), -1)
        next_mirror = len(faces)
        for i, face in enumerate(faces):
            edges = face.edges()
            self._edges[i, : len(edges)] = edges
            self._edge_counts.append(len(edges))
            if face.mirrored is not None:
                self._mirror_idx[i] = next_mirror
                next_mirror += 1
        self._texel_from_face = np.zeros((len(table), 3, 3))
        for i, (face, texture) in enumerate(zip(table, self._textures, strict=True)):
            height, width = texture.levels[0].shape[:2]
            s0, t0, s1, t1 = face.region
            self._texel_from_face[i] = [
                [(s1 - s0) * width, 0, s0 * width],
                [0, (t1 - t0) * height, t0 * height],
                [0, 0, 1],
            ]
        self._grids: dict[str, list[RayGrid]] = {}
        self._faces = faces
        bodies: dict[int, tuple[Body, list[int]]] = {}
        for i, face in enumerate(faces):
            if face.body is not None:
                bodies.setdefault(id(face.body), (face.body, []))[1].append(i)
        self._bodies = list(bodies.values())
        self._texture_sizes = np.array([t.levels[0].shape[1::-1] for t in self._textures])
        self._at_rest = self._origins.copy(), self._axes.copy(), self._texel_from_face.copy()
        self._sunlight: Sunlight | None = None
        self._shadows: dict[int, np.ndarray] = {}
        self._incidence = np.zeros(len(faces))
        self._gains: np.ndarray | None = None  # by face; None if all are one
        self._gain_images: dict[int, np.ndarray] = {}

    def set_time(self, time_s: float, sunlight: Sunlight | None = None) -> None:
        """Move the bodies to where they are at a time, and let the sun shine as it does then."""
        origins, axes, texel_from_face = self._at_rest
        for body, idx in self._bodies:
            place = body.at(time_s)
            self._origins[idx] = origins[idx] @ place.rotation.T + place.shift
            self._axes[idx] = axes[idx] @ place.rotation.T
            scroll = self._texture_sizes[idx] * place.scroll
            self._texel_from_face[idx, :2, 2] = texel_from_face[idx, :2, 2] + scroll
        if sunlight is None:
            self._gains, self._gain_images = None, {}
            return
        if sunlight is not self._sunlight:
            self._sunlight = sunlight
            self._shadows = cast_shadows(self._faces, sunlight.toward_sun)
            self._incidence = np.maximum(normals(self._faces) @ sunlight.toward_sun, 0.0)
        self._gains, self._gain_images = sunlight.gains(self._shadows, self._incidence, time_s)

    def render(self, center: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
        """Render a sharp image (H, W, 3) uint8 RGB from one pose: centre (3,) and rotation (3, 3)."""
        return _mean_samples(self._cast(self._grid("sharp")[0], center, cam_from_world))

    def render_exposure(self, centers: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
        """Render the mean (H, W, 3) uint8 over K poses during one exposure: (K, 3), (K, 3, 3).

        Each pose is rendered with one sample per pixel; poses symmetric in time use point-symmetric
        samples, so that the image is centred on the middle of the exposure.
        """
        count = len(centers)
        total = np.zeros((self._camera.height, self._camera.width, 3), np.float32)
        for k in range(count):
            sample = k % 4 if 2 * k < count else 3 - (count - 1 - k) % 4
            cv2.accumulate(
                self._cast(self._grid(f"single{sample}")[0], centers[k], cam_from_world[k]), total
            )
        return np.rint(total / count).astype(np.uint8)

    def render_rolling(self, centers: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
        """Render an image (H, W, 3) uint8 whose i-th band of `BAND_PX` rows is seen from the i-th of B poses.

        Raises ValueError if the number of poses differs from the number of bands.
        """
        bands = self._grid("bands")
        if len(bands) != len(centers):
            raise ValueError(f"{len(centers)} poses for {len(bands)} bands of rows")
        parts = [self._cast(*args) for args in zip(bands, centers, cam_from_world, strict=True)]
        return _mean_samples(np.concatenate(parts))

    def _grid(self, kind: str) -> list[RayGrid]:
        if kind not in self._grids:
            height = self._camera.height
            if kind == "bands":
                starts = range(0, height, BAND_PX)
                spans = [(row, min(row + BAND_PX, height)) for row in starts]
            else:
                spans = [(0, height)]
            offsets = SAMPLE_OFFSETS_PX
            if kind.startswith("single"):
                offsets = offsets[[int(kind[-1])]]
            self._grids[kind] = [
                RayGrid.of_rows(self._camera, offsets, *span, tile_rows=TILE_PX) for span in spans
            ]
        return self._grids[kind]

    def _face_from_ray(self, center: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return matrices (F, 3, 3) from a ray (x, y, 1) to (s, t, 1) / depth; NaN for faces seen edge-on."""
        offsets = self._origins - np.where(self._at_infinity[:, None], 0.0, center)
        matrices = np.concatenate([self._axes, offsets[:, None]], axis=1) @ rotation.T  # rows
        edge_on = np.abs(np.linalg.det(matrices)) < 1e-9
        matrices[edge_on] = np.eye(3)
        inverse = np.linalg.inv(np.swapaxes(matrices, 1, 2))
        inverse[edge_on] = np.nan
        return inverse

    def _cast(self, grid: RayGrid, center: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return the colours (h, w * samples, 3) uint8 of a grid's rays."""
        face_from_ray = self._face_from_ray(center, rotation)
        faces, keep, covered = self._faces_of_tiles(grid, face_from_ray, center)
        tile_idx, candidate = np.nonzero(keep.T)  # by tile
        face_idx = faces[candidate]
        levels = self._mip_levels(face_from_ray, face_idx, grid.jet[tile_idx])
        mirror_idx = self._mirror_idx[face_idx]
        mirror_levels = self._mip_levels(face_from_ray, mirror_idx, grid.jet[tile_idx])
        mirror_levels[mirror_idx < 0] = 0
        firsts = np.searchsorted(tile_idx, np.arange(len(grid.tiles) + 1))
        colours = np.empty((*grid.rays.shape[:2], 3), np.uint8)
        run: tuple[int, int, int] | None = (
            None  # face, level and mirror level of the tiles in `span`
        )
        span = (0, 0, 0, 0)
        for t, (r0, r1, c0, c1) in enumerate(grid.tiles.tolist()):
            first, last = int(firsts[t]), int(firsts[t + 1])
            alone = last - first == 1 and bool(covered[candidate[first], t])
            key = (
                (int(face_idx[first]), int(levels[first]), int(mirror_levels[first]))
                if alone
                else None
            )
            if run is not None and (key != run or r0 != span[0]):
                view = np.s_[span[0] : span[1], span[2] : span[3]]
                colours[view] = self._shade(face_from_ray, *run, grid.rays[view])
                run = None
            if key is not None:
                span = (r0, r1, span[2] if run is not None else c0, c1)
                run = key
            elif first == last:
                colours[r0:r1, c0:c1] = HAZE_RGB
            else:
                pairs = range(first, last)
                rays = np.ascontiguousarray(grid.rays[r0:r1, c0:c1]).reshape(-1, 2)
                mixed = self._shade_nearest(
                    face_from_ray,
                    [(int(face_idx[p]), int(levels[p]), int(mirror_levels[p])) for p in pairs],
                    [bool(covered[candidate[p], t]) for p in pairs],
                    rays,
                )
                colours[r0:r1, c0:c1] = mixed.reshape(r1 - r0, c1 - c0, 3)
        if run is not None:
            view = np.s_[span[0] : span[1], span[2] : span[3]]
            colours[view] = self._shade(face_from_ray, *run, grid.rays[view])
        return colours

    def _faces_of_tiles(
        self, grid: RayGrid, face_from_ray: np.ndarray, center: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return faces (M,) that may be visible, in which tiles (M, T), and which tiles they cover (M, T)."""
        n = self._visible_faces
        normals = np.cross(self._axes[:n, 0], self._axes[:n, 1])
        offsets = self._origins[:n] - np.where(self._at_infinity[:n, None], 0.0, center)
        seen = np.einsum("fi,fi->f", normals, offsets) > 0
        seen &= np.isfinite(face_from_ray[:n]).all(axis=(1, 2))
        # Linear forms of the ray, all >= 0 inside the face; the last is the inverse depth.
        forms = np.concatenate([self._edges @ face_from_ray[:n], face_from_ray[:n, 2:]], axis=1)
        low, high = (grid.middle - grid.half).min(axis=0), (grid.middle + grid.half).max(axis=0)
        middle, half = (low + high)[None] / 2, (high - low)[None] / 2
        seen &= (_form_bounds(forms, middle, half)[1] >= 0).all(axis=(1, 2))
        faces = np.flatnonzero(seen)
        low_m, high_m = _form_bounds(forms[faces], grid.middle, grid.half)  # (M, E, T)
        overlaps = (high_m >= -_EDGE_TOLERANCE).all(axis=1)
        covers = (low_m >= 0).all(axis=1)
        nearest = np.where(covers, low_m[:, -1], 0.0).max(axis=0, initial=0.0)
        return faces, np.asarray(overlaps & (high_m[:, -1] >= nearest)), np.asarray(covers)

    def _mip_levels(
        self, face_from_ray: np.ndarray, face_idx: np.ndarray, jet: np.ndarray
    ) -> np.ndarray:
        """Choose mip levels (P,) of faces (P,) at tiles with jets (P, 3, 3) by the pixel footprint."""
        q = self._texel_from_face[face_idx] @ face_from_ray[face_idx] @ jet
        inverse_depth = np.maximum(np.abs(q[:, 2, :1]), 1e-6)
        step = (q[:, :2, 1:] - q[:, :2, :1] * (q[:, 2:, 1:] / inverse_depth[:, None])) / (
            inverse_depth[:, None]
        )
        square = (step**2).sum(axis=(1, 2))
        det = np.abs(step[:, 0, 0] * step[:, 1, 1] - step[:, 0, 1] * step[:, 1, 0])
        major = np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * det**2, 0.0))) / 2)
        minor = det / np.maximum(major, 1e-12)
        # Texels of about one pixel; four samples per pixel allow finer texels along one axis.
        texels = np.maximum(0.85 * minor, 0.35 * major)
        deepest = np.array([len(texture.levels) - 1 for texture in self._textures])[face_idx]
        with np.errstate(divide="ignore", invalid="ignore"):
            level = np.nan_to_num(np.rint(np.log2(texels)), posinf=0.0, neginf=0.0)
        return np.clip(level, 0, deepest).astype(np.int64)

    def _sample(
        self, face_from_ray: np.ndarray, face: int, level: int, rays: np.ndarray
    ) -> np.ndarray:
        """Sample the texture (h, w, 3 or 4) of a face along rays (h, w, 2), reflected beyond its border."""
        base = self._textures[face].levels[0].shape
        image = self._textures[face].levels[level]
        sx, sy = image.shape[1] / base[1], image.shape[0] / base[0]
        level_from_texel = OPENCV_FROM_COLMAP @ np.diag([sx, sy, 1.0])
        texel_from_ray = level_from_texel @ self._texel_from_face[face] @ face_from_ray[face]
        texels = cv2.perspectiveTransform(rays, texel_from_ray)
        return cv2.remap(image, texels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)

    def _shade(
        self, face_from_ray: np.ndarray, face: int, level: int, mirror_level: int, rays: np.ndarray
    ) -> np.ndarray:
        """Return the colours (h, w, 3) of a face along rays (h, w, 2), with its reflections and the light."""
        colours = self._surface(face_from_ray, face, level, mirror_level, rays)
        if self._gains is None or self._at_infinity[face]:
            return colours
        if face not in self._gain_images:
            return cv2.convertScaleAbs(colours, alpha=float(self._gains[face]))
        image = self._gain_images[face]
        scale = np.diag([image.shape[1], image.shape[0], 1.0])
        texels = cv2.perspectiveTransform(rays, OPENCV_FROM_COLMAP @ scale @ face_from_ray[face])
        gain = cv2.remap(image, texels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cv2.multiply(colours, gain, scale=1 / GAIN_UNIT)

    def _surface(
        self, face_from_ray: np.ndarray, face: int, level: int, mirror_level: int, rays: np.ndarray
    ) -> np.ndarray:
        """Return the colours (h, w, 3) of a face along rays (h, w, 2) as painted, with its reflections."""
        own = self._sample(face_from_ray, face, level, rays)
        if own.shape[2] == 3:
            return own
        share = own[:, :, 3]
        own = cv2.cvtColor(own, cv2.COLOR_RGBA2RGB)
        mirror = int(self._mirror_idx[face])
        if mirror < 0 or not share.any():
            return own
        reflected = self._sample(face_from_ray, mirror, mirror_level, rays)
        weight = share.astype(np.float32) * np.float32(1 / 255)
        return cv2.blendLinear(reflected[:, :, :3].copy(), own, weight, 1 - weight)

    def _shade_nearest(
        self,
        face_from_ray: np.ndarray,
        keys: list[tuple[int, int, int]],
        covered: list[bool],
        rays: np.ndarray,
    ) -> np.ndarray:
        """Return the colours (n, 3) along rays (n, 2) of the nearest of faces (face, level, mirror level)."""
        nearest = np.zeros(len(rays), np.float32)
        winner = np.full(len(rays), -1, np.int16)
        across = np.ascontiguousarray(rays.T)
        for j, ((face, _, _), covers) in enumerate(zip(keys, covered, strict=True)):
            forms = face_from_ray[face, 2:]
            if not covers:
                edges = self._edges[face, : self._edge_counts[face]] @ face_from_ray[face]
                forms = np.concatenate([forms, edges])
            forms = forms.astype(np.float32)
            values = forms[:, :2] @ across
            values += forms[:, 2:]
            closer = values[0] > nearest
            if not covers:
                closer &= values[1:].min(axis=0) >= -_EDGE_TOLERANCE
            np.copyto(nearest, values[0], where=closer)
            np.copyto(winner, j, where=closer)
        colours = np.empty((len(rays), 3), np.uint8)
        colours[winner < 0] = HAZE_RGB
        for j, key in enumerate(keys):
            chosen = np.flatnonzero(winner == j)
            if len(chosen):
                colours[chosen] = self._shade(face_from_ray, *key, rays[chosen][None])[0]
        return colours


def _mean_samples(colours: np.ndarray) -> np.ndarray:
    """Average samples (h, 4 w, 3) to pixels (h, w, 3)."""
    height, width = colours.shape[0], colours.shape[1] // len(SAMPLE_OFFSETS_PX)
    return cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)


def _form_bounds(
    forms: np.ndarray, middle: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return minimum and maximum (F, E, T) of linear forms (F, E, 3) over boxes of rays (T, 2), (T, 2)."""
    value = forms[..., :2] @ middle.T + forms[..., 2:]
    spread = np.abs(forms[..., :2]) @ half.T
    return value - spread, value + spread
