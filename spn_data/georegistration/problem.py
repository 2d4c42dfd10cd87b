"""Residuals and Jacobian of the georegistration: all observations as functions of a similarity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from spn_data.geometry.least_squares import similarity_jacobian
from spn_data.geometry.pose import Similarity
from spn_data.geometry.rotations import quats_from_rotations, rotations_from_vectors
from spn_data.georegistration.control import Control
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.georegistration.noise import Chains, LinearSystem, NoiseLevels
from spn_data.georegistration.observe import Fixes

SHARED = 7  # parameters: centre (3), rotation vector in the world (3), logarithm of scale
_FREE_HEIGHT_M = 1e3  # sigma of an unknown height
# Prior on rotation and scale about their current values. It introduces no bias, and keeps the normal
# equations of a straight line regular.
_WEAK_PRECISION = 1e-2


class Kind(IntEnum):
    """Kind of an observation; index along the first axis of the residuals."""

    EAST = 0
    NORTH = 1
    UP = 2
    PITCH = 3  # rotation in degrees about the image's x axis (right)
    ROLL = 4  # rotation in degrees about the axis orthogonal to that and to up
    LEVEL = 5  # elevation in degrees of the image's x axis above the horizon
    HEADING = 6  # rotation in degrees about up


# Prior noise levels: (bias, spread of its logarithm, white, spread of its logarithm), in the observation's
# sigma. Consumer GNSS: nearly all of the stated sigma is a slow bias; short-term noise is a tenth to a half
# of it. Differential fixes: mostly white. Gimbal, in degrees: drift in addition to the constant bias, and
# noise.
_NOISE_PRIOR = [
    (0.97, 0.4, 0.1, 1.0),  # horizontal
    (0.97, 0.4, 0.1, 1.0),  # vertical
    (0.4, 1.0, 0.8, 0.6),  # horizontal, differential
    (0.4, 1.0, 0.8, 0.6),  # vertical, differential
    (0.05, 0.7, 0.15, 0.8),  # gimbal
    (0.1, 0.0, 1.0, 0.0),  # level camera
    (5.0, 0.0, 0.2, 0.8),  # heading of the gimbal, in degrees
]
_HORIZONTAL, _VERTICAL, _RTK, _GIMBAL, _LEVEL, _HEADING = 0, 1, 2, 4, 5, 6
# The error of a compass is several degrees over a whole flight and changes slowly.
_HEADING_TIME_S = 1000.0


@dataclass(frozen=True, eq=False)
class FitState:
    """Current parameters: ``x_world = scale * rotation @ x_model + center`` in centred model coordinates.

    offsets_m : (F,) height of each flight's zero above the first flight's; gimbal_deg : (F, 3) constant
    gimbal error of each flight about the camera's axes; level_deg : (F,) mean roll of frames without gimbal
    angles; bias : (G, 3) common error of each bias group's fixes, in its sigma.
    """

    rotation: np.ndarray
    scale: float
    center: np.ndarray
    offsets_m: np.ndarray
    gimbal_deg: np.ndarray
    level_deg: np.ndarray
    bias: np.ndarray

    def updated(self, step: np.ndarray) -> FitState:
        """Apply a step (P,) of all parameters."""
        f = len(self.offsets_m)
        return FitState(
            rotations_from_vectors(step[3:6]) @ self.rotation,
            self.scale * float(np.exp(step[6])),
            self.center + step[:3],
            self.offsets_m + step[SHARED : SHARED + f],
            self.gimbal_deg + step[SHARED + f : SHARED + 4 * f].reshape(f, 3),
            self.level_deg + step[SHARED + 4 * f : SHARED + 5 * f],
            self.bias + step[SHARED + 5 * f :].reshape(-1, 3),
        )

    @property
    def similarity(self) -> Similarity:
        """From centred model coordinates to the world."""
        return Similarity(self.scale, self.rotation, self.center)

    @property
    def nuisance(self) -> np.ndarray:
        """Parameters (5 F + 3 G,) other than the similarity."""
        return np.concatenate(
            [self.offsets_m, self.gimbal_deg.ravel(), self.level_deg, self.bias.ravel()]
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """Frames, their observations, and the noise model of each observation.

    model : (N, 3) camera centres, centred and scaled to unit size; cam_from_model : (N, 3, 3); use_level :
    (N,) bool, frames whose roll is observed as zero; kind, frame : (M,) kind and frame index of each
    observation, in the order of `chains`; control : surveyed points, in the coordinates of `model`.
    """

    model: np.ndarray
    cam_from_model: np.ndarray
    fixes: Fixes
    use_level: np.ndarray
    options: GeoregisterOptions
    chains: Chains
    kind: np.ndarray
    frame: np.ndarray
    control: Control | None = None

    @classmethod
    def build(
        cls,
        model: np.ndarray,
        cam_from_model: np.ndarray,
        fixes: Fixes,
        use_level: np.ndarray,
        options: GeoregisterOptions,
        control: Control | None = None,
    ) -> Problem:
        """Collect the observations; see the class for the arguments."""
        gimbal = np.isfinite(fixes.up_cam).all(axis=1)
        heading = np.isfinite(fixes.attitude).all(axis=(1, 2))
        present = np.stack([*np.isfinite(fixes.enu_m).T, gimbal, gimbal, use_level, heading])
        present[:2] &= fixes.has_fix
        kind, frame = np.nonzero(present)
        rtk = fixes.is_rtk[frame]
        unit = np.where(kind <= Kind.UP, fixes.sigma_m[frame, np.minimum(kind, 2)], 1.0)
        unit = np.where(kind == Kind.LEVEL, options.level_camera_sigma_deg, unit)
        group = np.where(kind == Kind.UP, _VERTICAL, _HORIZONTAL) + np.where(rtk, _RTK, 0)
        group = np.where(kind >= Kind.PITCH, _GIMBAL, group)
        group = np.where(kind == Kind.LEVEL, _LEVEL, group)
        group = np.where(kind == Kind.HEADING, _HEADING, group)
        chain = (kind * len(fixes.flights) + fixes.flight[frame]) * 2 + (rtk & (kind <= Kind.UP))
        # East and north are outliers together, as are the two gimbal angles; a height is one on its own.
        twin = np.array([0, 0, 1, 2, 2, 3, 4])[kind] * len(model) + frame
        tau = np.where(kind == Kind.HEADING, _HEADING_TIME_S, options.correlation_time_s)
        chains, order = Chains.build(chain, fixes.time_s[frame], tau, group, unit, twin)
        kind, frame = kind[order], frame[order]
        return cls(model, cam_from_model, fixes, use_level, options, chains, kind, frame, control)

    def prior_levels(self) -> NoiseLevels:
        """Return the prior noise levels."""
        return NoiseLevels.from_table(_NOISE_PRIOR)

    def conservative_levels(self, levels: NoiseLevels) -> NoiseLevels:
        """Apply lower limits to noise levels, for deciding which parameters the data determine.

        Without them, fixes that agree by chance or because they were filtered would look too accurate.
        """
        floor_bias = np.array([0.5, 0.5, 0.2, 0.2, 0.0, 0.0, 0.0])
        floor_white = np.array([0.3, 0.3, 0.7, 0.7, 0.2, 0.0, 0.2])
        return levels.at_least(floor_bias, floor_white)

    def initial_state(self, world_from_model: Similarity, inlier: np.ndarray) -> FitState:
        """Return the state of an initial similarity; vertical offsets are medians over its inliers (N,)."""
        f = len(self.fixes.flights)
        offsets = np.zeros(f)
        up = world_from_model.apply(self.model)[:, 2] - self.fixes.enu_m[:, 2]
        if self.fixes.free_heights:
            for k in range(f):
                mine = inlier & (self.fixes.flight == k) & np.isfinite(up)
                offsets[k] = np.median(up[mine]) if mine.any() else 0.0
        return FitState(
            world_from_model.rotation,
            world_from_model.scale,
            world_from_model.translation,
            offsets,
            np.zeros((f, 3)),
            np.zeros(f),
            np.zeros((self.fixes.bias_group.max() + 1, 3)),
        )

    def linearise(
        self, state: FitState, offset_sigma_m: np.ndarray, bias_weight: np.ndarray
    ) -> LinearSystem:
        """Linearise all observations at a state.

        offset_sigma_m : (F,) prior sigma of the vertical offsets about zero; bias_weight : (F,) robust
        weights of the flights' gimbal biases.
        """
        residual, jacobian = self._dense_residuals(state)
        f = len(self.fixes.flights)
        bias = np.sqrt(1 / bias_weight) * self.options.gimbal_bias_deg
        precision = np.concatenate(
            [
                np.array([0.0, 0.0, 0.0, *[_WEAK_PRECISION] * 4]),
                1 / offset_sigma_m**2,
                1 / np.repeat(bias, 3) ** 2,
                np.full(f, 1 / self.options.level_camera_sigma_deg**2),
                self._bias_precision(state),
            ]
        )
        value = np.concatenate([np.zeros(SHARED), state.nuisance])
        if not self.fixes.has_heights:
            precision[2], value[2] = 1 / _FREE_HEIGHT_M**2, state.center[2]
        rows = self.kind, self.frame
        control = None if self.control is None else self._control_rows(state, len(value))
        return LinearSystem(residual[rows], jacobian[rows], precision, value, control)

    def _bias_precision(self, state: FitState) -> np.ndarray:
        """Return the prior precision (3 G,) of the biases; the zero of heights may be free."""
        precision = np.ones_like(state.bias)
        if self.fixes.free_zero:
            group, known = self.fixes.bias_group, np.isfinite(self.fixes.enu_m[:, 2])
            for g in np.unique(group[known]):
                usual = self.fixes.bias_m[known & (group == g), 2].mean()
                precision[g, 2] = (usual / _FREE_HEIGHT_M) ** 2
        return precision.ravel()

    def _control_rows(self, state: FitState, parameters: int) -> np.ndarray:
        """Return jacobian and residual (3 C, P + 1) of the control points, weighted and of unit variance."""
        assert self.control is not None
        residual, jacobian, weight = self.control.whitened(state.similarity)
        rows = np.zeros((residual.size, parameters + 1))
        root = np.sqrt(np.repeat(weight, 3))[:, None]
        rows[:, :SHARED] = jacobian.reshape(-1, SHARED) * root
        rows[:, -1] = residual.ravel() * root[:, 0]
        return rows

    def _dense_residuals(self, state: FitState) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (7, N) and their Jacobian (7, N, P); NaN for missing observations."""
        n, f = len(self.model), len(self.fixes.flights)
        flight, every = self.fixes.flight, np.arange(n)
        residual: np.ndarray = np.full((len(Kind), n), np.nan)
        jacobian: np.ndarray = np.zeros((len(Kind), n, SHARED + 5 * f + state.bias.size))
        lever = state.scale * self.model @ state.rotation.T
        residual[:3] = (self.fixes.enu_m - lever - state.center).T
        residual[2] += state.offsets_m[flight]
        group = self.fixes.bias_group
        residual[:3] -= (self.fixes.bias_m * state.bias[group]).T
        jacobian[:3, :, :SHARED] = similarity_jacobian(lever).transpose(1, 0, 2)
        for k in range(3):
            jacobian[k, every, SHARED + 5 * f + 3 * group + k] = self.fixes.bias_m[:, k]
        jacobian[2, every, SHARED + flight] = -1.0

        cam_from_world = self.cam_from_model @ state.rotation.T
        up = cam_from_world[:, :, 2]
        # Rotation in degrees, about the camera's axes, from the model's up to the gimbal's up.
        cross = np.cross(up, self.fixes.up_cam)
        sine = np.linalg.norm(cross, axis=1)
        cosine = np.einsum("ni,ni->n", up, self.fixes.up_cam)
        with np.errstate(invalid="ignore", divide="ignore"):
            stretch = np.where(sine > 1e-9, np.arctan2(sine, cosine) / sine, 1.0)
        turn_deg = np.rad2deg(cross * stretch[:, None])
        for kind, axis in zip((Kind.PITCH, Kind.ROLL), _tilt_axes(up), strict=True):
            bias = np.einsum("ni,ni->n", axis, state.gimbal_deg[flight])
            residual[kind] = np.einsum("ni,ni->n", axis, turn_deg) - bias
            jacobian[kind, :, 3:6] = -np.rad2deg(np.einsum("ni,nij->nj", axis, cam_from_world))
            for k in range(3):
                jacobian[kind, every, SHARED + f + 3 * flight + k] = axis[:, k]

        residual[Kind.LEVEL] = -np.rad2deg(up[:, 0]) - state.level_deg[flight]
        turned = up[:, 1, None] * cam_from_world[:, 2] - up[:, 2, None] * cam_from_world[:, 1]
        jacobian[Kind.LEVEL, :, 3:6] = np.rad2deg(turned)
        jacobian[Kind.LEVEL, every, SHARED + 4 * f + flight] = 1.0

        if np.isfinite(self.fixes.attitude).any():
            residual[Kind.HEADING] = _turn_about_up_deg(self.fixes.attitude, cam_from_world)
            jacobian[Kind.HEADING, :, 5] = np.rad2deg(1.0)
        return residual, jacobian

    def residuals(self, state: FitState) -> np.ndarray:
        """Return the residuals (7, N) of all kinds; NaN for missing observations."""
        residual = self._dense_residuals(state)[0]
        residual[Kind.LEVEL] = np.where(self.use_level, residual[Kind.LEVEL], np.nan)
        return residual

    def moved(self, model: np.ndarray, cam_from_model: np.ndarray) -> Problem:
        """Return the problem with other centred camera centres (N, 3) and rotations (N, 3, 3)."""
        return replace(self, model=model, cam_from_model=cam_from_model)

    def without_level(self) -> Problem:
        """Return the problem without the level-camera assumption, using measurements only."""
        return self.build(
            self.model,
            self.cam_from_model,
            self.fixes,
            np.zeros_like(self.use_level),
            self.options,
            self.control,
        )

    def on_frames(self, mask: np.ndarray) -> Problem:
        """Return the problem restricted to observations of the frames in a mask (N,)."""
        return self.build(
            self.model,
            self.cam_from_model,
            self.fixes.only(mask),
            self.use_level & mask,
            self.options,
            self.control,
        )


def _tilt_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pitch and roll axes (N, 3 each), unit and orthogonal to up (N, 3), in camera axes."""
    # If the camera is rolled onto its side, up is along its x axis, so the z axis is used instead.
    sideways = np.abs(up[:, :1]) > 0.9
    axis = np.where(sideways, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = axis - np.einsum("ni,ni->n", axis, up)[:, None] * up
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(up, first)


def _turn_about_up_deg(attitude: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """Return the world's rotation (N,) about up, in degrees, that aligns cam_from_world with the attitude."""
    known = np.isfinite(attitude).all(axis=(1, 2))
    turn = np.full(len(attitude), np.nan)
    quats = quats_from_rotations(attitude[known].transpose(0, 2, 1) @ cam_from_world[known])
    # Twist about z of a rotation that may also contain a small tilt.
    angle = np.rad2deg(2 * np.arctan2(quats[:, 3], quats[:, 0]))
    turn[known] = (angle + 180.0) % 360.0 - 180.0
    return turn
