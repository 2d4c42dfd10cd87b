"""Ground control in the georegistration: surveyed points as observations of the fit, and their residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.least_squares import similarity_jacobian
from spn_data.geometry.pose import Similarity
from spn_data.ground_control.triangulation import Views

# Huber's limit of a point's distance in sigma, for three coordinates.
_HUBER_SIGMAS = 2.8
_MEDIAN_SIGMAS = 1.54  # of the distance of a point, if its errors are as stated
_OUTLIER_SIGMAS = 6.0
_UNKNOWN_M = 1e4  # sigma of a coordinate that was not surveyed


@dataclass(frozen=True, eq=False)
class Control:
    """K surveyed points in the model and in the world.

    Attributes
    ----------
    names : tuple of str
    model : ndarray, shape (K, 3)
        Triangulated from their marks.
    model_covariance : ndarray, shape (K, 3, 3)
    enu_m : ndarray, shape (K, 3)
        Surveyed, in the frame of `origin`; an unknown height is NaN.
    sigma_m : ndarray, shape (K, 3)
        Of the survey.
    check : ndarray of bool, shape (K,)
        Points that are held out.
    origin : GeoOrigin
    used : ndarray of bool, shape (K,)
        Points that the fit uses.
    views : tuple of Views
        Marks of each point.
    scale : float
        Factor of their sigma, from their residuals.
    """

    names: tuple[str, ...]
    model: np.ndarray
    model_covariance: np.ndarray
    enu_m: np.ndarray
    sigma_m: np.ndarray
    check: np.ndarray
    origin: GeoOrigin
    used: np.ndarray
    views: tuple[Views, ...]
    scale: float = 1.0

    def __len__(self) -> int:
        return len(self.names)

    def centred(self, middle: np.ndarray, size: float) -> Control:
        """Return the points in model coordinates relative to a middle (3,), divided by a size."""
        return replace(
            self,
            model=(self.model - middle) / size,
            model_covariance=self.model_covariance / size**2,
        )

    def errors_m(self, world_from_model: Similarity) -> np.ndarray:
        """Return surveyed minus fitted coordinates (K, 3)."""
        return self.enu_m - world_from_model.apply(self.model)

    def covariance_m(self, world_from_model: Similarity) -> np.ndarray:
        """Return the covariance (K, 3, 3) of the errors due to survey and marks."""
        turn = world_from_model.scale * world_from_model.rotation
        survey = np.where(np.isfinite(self.enu_m), self.sigma_m, _UNKNOWN_M) ** 2
        return survey[:, :, None] * np.eye(3) + turn @ self.model_covariance @ turn.T

    def whitened(self, world_from_model: Similarity) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the used points' errors (C, 3) and derivatives (C, 3, 7), unit variance, and weights (C,).

        The derivatives are those of `similarity_jacobian`. The weights are Huber's: one wrong point cannot
        pull the fit far.
        """
        used = np.flatnonzero(self.used)
        covariance = self.covariance_m(world_from_model)[used] * self.scale**2
        error = np.nan_to_num(self.errors_m(world_from_model)[used])
        lever = world_from_model.apply(self.model[used]) - world_from_model.translation
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        error = np.einsum("kij,kj->ki", white, error)
        distance = np.linalg.norm(error, axis=1)
        weight = np.minimum(1.0, _HUBER_SIGMAS / np.maximum(distance, 1e-12))
        return error, white @ similarity_jacobian(lever), weight

    def initial(self) -> Similarity:
        """Return the similarity from the used points; raise GeometryError if they do not determine it."""
        known = self.used & np.isfinite(self.enu_m).all(axis=1)
        if known.sum() < 3:
            raise GeometryError(
                f"there are only {int(known.sum())} ground control points to use; without telemetry, three "
                "that are not in one line are needed"
            )
        return Similarity.fit(self.model[known], self.enu_m[known])

    def judged(self, world_from_model: Similarity) -> Control:
        """Return the points without those that are far off, and with the sigma that the others' errors show.

        Both need more points than determine the seven parameters.
        """
        error, _, _ = self.whitened(world_from_model)
        used = np.flatnonzero(self.used)
        distance = np.linalg.norm(error, axis=1)
        spread = max(1.0, float(np.median(distance)) / _MEDIAN_SIGMAS) if len(used) else 1.0
        kept = used[distance <= _OUTLIER_SIGMAS * spread]
        if len(used) < 4 or len(kept) < 3:
            return self
        square = float((error[np.isin(used, kept)] ** 2).sum())
        scale = np.sqrt(square / (3 * len(kept) - 7)) if len(kept) > 3 else 1.0
        mask = np.zeros_like(self.used)
        mask[kept] = True
        return replace(self, used=mask, scale=self.scale * max(1.0, float(scale)))


@dataclass(frozen=True)
class PointResidual:
    """Residual of a surveyed point.

    Attributes
    ----------
    name : str
    role : str
        "control" or "check".
    marks : int
        Marks used.
    residual_m : tuple of float
        Surveyed minus mapped: east, north, up; NaN if unknown.
    sigma_m : tuple of float
        Standard deviation of the residual, from survey, marks and georegistration.
    reprojection_px : float
        RMS distance of its marks from where the map projects the surveyed position; NaN if unknown.
    is_outlier : bool
        A control point that is left out because it is too far off.
    """

    name: str
    role: str
    marks: int
    residual_m: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    reprojection_px: float
    is_outlier: bool = False


def point_residuals(
    control: Control, world_from_model: Similarity, point_covariance: np.ndarray
) -> tuple[PointResidual, ...]:
    """Return the residuals of all points.

    Parameters
    ----------
    control : Control
        In the coordinates of the model.
    world_from_model : Similarity
    point_covariance : ndarray, shape (K, 3, 3)
        Of the georegistration at the points.

    Returns
    -------
    tuple of PointResidual
    """
    covariance = control.covariance_m(world_from_model)
    errors = control.errors_m(world_from_model)
    model_from_world = world_from_model.inverse()
    found = []
    for k, name in enumerate(control.names):
        # A fitted point has made the georegistration fit itself.
        both = covariance[k] if control.used[k] else covariance[k] + point_covariance[k]
        pixels = control.views[k].residuals_px(model_from_world.apply(control.enu_m[k]))
        sigma = np.where(np.isfinite(errors[k]), np.sqrt(np.diag(both)), np.nan)
        found.append(
            PointResidual(
                name,
                "check" if control.check[k] else "control",
                len(control.views[k]),
                _triple(errors[k]),
                _triple(sigma),
                float(np.sqrt((pixels**2).sum(axis=1).mean())),
                not control.check[k] and not bool(control.used[k]),
            )
        )
    return tuple(found)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def rmse_m(points: tuple[PointResidual, ...]) -> tuple[float, float]:
    """Return the horizontal and vertical RMSE in metres of points; NaN if none is known."""
    residual = np.array([p.residual_m for p in points]).reshape(-1, 3)
    horizontal = np.hypot(residual[:, 0], residual[:, 1])
    found = []
    for values in (horizontal, residual[:, 2]):
        values = values[np.isfinite(values)]
        found.append(float(np.sqrt(np.mean(values**2))) if len(values) else float("nan"))
    return found[0], found[1]
