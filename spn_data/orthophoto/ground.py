"""Ground of a map: a raster of its height, fitted to the map points on it, and of what stands on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from spn_data.errors import GeometryError

_CELLS_A_SIDE = 80
_SMALLEST_CELL_M = 1.0
_MARGIN = 0.5  # of the extent of the cameras: how far beyond them the raster reaches
_MIN_MARGIN_M = 20.0
_MIN_POINTS = 3  # in a cell
_LOW, _MIDDLE, _TOP = 10.0, 50.0, 95.0  # percentiles of the heights in a cell
_FLAT_M = 0.5  # between the lowest and the highest points of a flat cell, beside its slope
_SLOPE = 0.3  # steepest ground
_STEP_M = 0.15  # from a cell to the next, beside the slope
_SAMPLES = 500  # planes that are tried
_PLANE_M = 0.25  # from the plane to its cells
_BELOW = 0.02  # largest share of cells that may lie below the ground (reflections, wrong matches)
_MIN_CELLS = 10  # with ground
_STANDS_M = 1.0  # above the ground: what is higher hides what is behind
_REACH_CELLS = (
    5.0  # from a cell with ground points: farther away, the ground is the plane or unknown
)
_LEVEL_M = 0.3  # deviations from the plane up to which it holds farther away


@dataclass(frozen=True, eq=False)
class GroundRaster:
    """Heights in square cells; row 0 is in the south, column 0 in the west, NaN is unknown.

    Attributes
    ----------
    low : ndarray, shape (2,)
        East and north of the south-western corner.
    cell_m : float
        Side of a cell.
    height_m : ndarray, shape (R, C)
        Height of the ground, interpolated between cells with ground points.
    spread_m : ndarray, shape (R, C)
        Standard deviation of the ground points of a cell about their median (robust).
    top_m : ndarray, shape (R, C)
        Height of the highest things in a cell, at least that of the ground.
    """

    low: np.ndarray
    cell_m: float
    height_m: np.ndarray
    spread_m: np.ndarray
    top_m: np.ndarray

    @property
    def centers(self) -> np.ndarray:
        """East, north and height (R, C, 3) of the middle of each cell."""
        return np.dstack([*self._grid(0.5), self.height_m])

    @property
    def corners(self) -> np.ndarray:
        """East and north (R + 1, C + 1, 2) of the corners of the cells."""
        rows, columns = self.height_m.shape
        x = self.low[0] + self.cell_m * np.arange(columns + 1)
        y = self.low[1] + self.cell_m * np.arange(rows + 1)
        return np.dstack(np.meshgrid(x, y))

    def _grid(self, offset: float) -> list[np.ndarray]:
        rows, columns = self.height_m.shape
        x = self.low[0] + self.cell_m * (np.arange(columns) + offset)
        y = self.low[1] + self.cell_m * (np.arange(rows) + offset)
        return list(np.meshgrid(x, y))

    def cells_of(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return row, column and whether inside, of positions (..., 2); outside ones get the nearest cell."""
        index = np.floor((xy - self.low) / self.cell_m).astype(np.int64)
        shape = np.array(self.height_m.shape)[::-1]
        inside = np.all((index >= 0) & (index < shape), axis=-1)
        index = np.clip(index, 0, shape - 1)
        return index[..., 1], index[..., 0], inside


def fit_ground(points: np.ndarray, cameras: np.ndarray) -> GroundRaster:
    """Fit the ground to the map points of flat places.

    Cells whose points all have about one height are flat: the ground, roofs and tables are, facades and
    crowns of trees are not. The ground is the plane that holds most flat cells and has hardly any below it,
    and what continues it without a step.

    Parameters
    ----------
    points : ndarray, shape (P, 3)
        Map points, east, north, up in metres.
    cameras : ndarray, shape (N, 3)
        Centres of the mapping cameras: the ground is wanted around them.

    Returns
    -------
    GroundRaster

    Raises
    ------
    GeometryError
        If hardly any points lie on a ground.
    """
    low, high = cameras[:, :2].min(axis=0), cameras[:, :2].max(axis=0)
    margin = max(_MIN_MARGIN_M, _MARGIN * float((high - low).max()))
    low, high = low - margin, high + margin
    points = points[np.all((points[:, :2] > low) & (points[:, :2] < high), axis=1)]
    if len(points) < _MIN_POINTS:
        raise GeometryError("the map has no points around its cameras, so the ground is unknown")
    bulk = np.percentile(points[:, :2], [1, 99], axis=0)
    low, high = np.maximum(low, bulk[0]), np.minimum(high, bulk[1])
    cell = max(_SMALLEST_CELL_M, float((high - low).max()) / _CELLS_A_SIDE)
    columns, rows = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
    index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    inside = np.all((index >= 0) & (index < [columns, rows]), axis=1)
    cells, z = (index[:, 1] * columns + index[:, 0])[inside], points[inside, 2]
    order = np.lexsort((z, cells))
    found, heights = _by_cell(cells[order], z[order])
    xy = low + cell * (np.column_stack([found % columns, found // columns]) + 0.5)
    lows, level, tops = (
        np.array([np.percentile(h, [_LOW, _MIDDLE, _TOP]) for h in heights]).reshape(-1, 3).T
    )
    flat = tops - lows <= _FLAT_M + _SLOPE * cell
    plane = _lowest_plane(xy, level, lows, flat)
    is_ground = _grown(xy, level, flat, plane, cell)
    shape = (int(rows), int(columns))
    height = _interpolate(xy[is_ground], level[is_ground], plane, low, cell, shape)
    spread = [
        1.4826 * float(np.median(np.abs(heights[k] - level[k]))) for k in np.flatnonzero(is_ground)
    ]
    spreads, top = np.full(shape, np.nan), height.copy()
    spreads.ravel()[found[is_ground]] = spread
    stands = tops > height.ravel()[found] + _STANDS_M
    top.ravel()[found[stands]] = tops[stands]
    return GroundRaster(low, cell, height, spreads, top)


def _by_cell(cells: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the cells with enough points, and their heights; `cells` are sorted."""
    found, first, count = np.unique(cells, return_index=True, return_counts=True)
    kept = count >= _MIN_POINTS
    starts, ends = first[kept], (first + count)[kept]
    return found[kept], [z[a:b] for a, b in zip(starts, ends, strict=True)]


def _lowest_plane(
    xy: np.ndarray, level: np.ndarray, lows: np.ndarray, flat: np.ndarray
) -> np.ndarray:
    """Return the plane (3,), height by 1, east, north, of most flat cells with hardly any cell below it."""
    unknown = GeometryError(
        "the map has too few points on level ground between the cameras, so its height is unknown"
    )
    rows = np.flatnonzero(flat)
    if len(rows) < _MIN_CELLS:
        raise unknown
    design = np.column_stack([np.ones(len(xy)), xy])
    random = np.random.default_rng(0)
    best, most = np.zeros(len(xy), bool), _MIN_CELLS - 1
    for _ in range(_SAMPLES):
        some = random.choice(rows, 3, replace=False)
        if abs(np.linalg.det(design[some])) < 1.0:
            continue
        plane = np.linalg.solve(design[some], level[some])
        above = lows - design @ plane
        if np.hypot(*plane[1:]) > _SLOPE or (above < -2 * _PLANE_M).mean() > _BELOW:
            continue
        near = flat & (np.abs(level - design @ plane) <= _PLANE_M)
        if near.sum() > most:
            best, most = near, int(near.sum())
    if not best.any():
        raise unknown
    return np.linalg.lstsq(design[best], level[best], rcond=None)[0]


def _grown(
    xy: np.ndarray, level: np.ndarray, flat: np.ndarray, plane: np.ndarray, cell: float
) -> np.ndarray:
    """Return the flat cells on the plane, and those that continue them without a step."""
    on_plane = plane[0] + xy @ plane[1:]
    ground = flat & (np.abs(level - on_plane) <= _PLANE_M)
    apart, neighbour = cKDTree(xy).query(xy, k=min(29, len(xy)), distance_upper_bound=3.1 * cell)
    near = np.isfinite(apart)
    neighbour = np.where(near, neighbour, 0)
    joins = near & (np.abs(level[neighbour] - level[:, None]) <= _STEP_M + _SLOPE * apart)
    while True:
        grown = ground | (flat & (joins & ground[neighbour]).any(axis=1))
        if (grown == ground).all():
            return ground
        ground = grown


def _interpolate(
    xy: np.ndarray,
    level: np.ndarray,
    plane: np.ndarray,
    low: np.ndarray,
    cell: float,
    shape: tuple[int, int],
) -> np.ndarray:
    """Return heights (R, C): linear between cells with ground, then those of the nearest, then the plane."""
    rows, columns = shape
    grid = np.dstack(np.meshgrid(np.arange(columns), np.arange(rows))).reshape(-1, 2)
    wanted = low + cell * (grid + 0.5)
    above = level - (plane[0] + xy @ plane[1:])
    distance, nearest = cKDTree(xy).query(wanted)
    height = above[nearest]
    if np.linalg.matrix_rank(xy - xy[0]) == 2:
        linear = LinearNDInterpolator(xy, above)(wanted)
        height = np.where(np.isfinite(linear), linear, height)
    is_level = float(np.percentile(np.abs(above), 90)) <= _LEVEL_M
    height[distance > _REACH_CELLS * cell] = 0.0 if is_level else np.nan
    return (height + plane[0] + wanted @ plane[1:]).reshape(shape)
