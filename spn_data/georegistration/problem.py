"""The observations of georegistration as residuals of a similarity, linearised."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from spn_data.geometry.pose import Similarity, quats_from_rotations, rotations_from_vectors
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.georegistration.noise import Chains, Levels, Linear
from spn_data.georegistration.observe import Fixes

SHARED = 7  # parameters: centre (3), rotation vector in the world (3), logarithm of scale
_FREE_HEIGHT_M = 1e3  # sigma of a height that nothing is known of
# Of rotation and scale about their present values: pulls nowhere, keeps a straight line's equations solvable.
_WEAK_PRECISION = 1e-2


class Kind(IntEnum):
    """What an observation is of; the first axis of residuals."""

    EAST = 0
    NORTH = 1
    UP = 2
    PITCH = 3  # rotation in degrees about the image's right
    ROLL = 4  # about what is across both that and up
    LEVEL = 5  # of the image's right above the horizon
    HEADING = 6  # rotation in degrees about up


# Noise levels: (bias, spread of its logarithm, white, spread of its logarithm), in the observation's sigma.
# Consumer GNSS: nearly all of the stated sigma is slow bias, and its short-term noise a tenth to a half.
# Differential fixes: mostly white. Gimbal, in degrees: drift beside the flight's constant bias, and noise.
_TABLE = [
    (0.97, 0.4, 0.1, 1.0),  # horizontal
    (0.97, 0.4, 0.1, 1.0),  # vertical
    (0.4, 1.0, 0.8, 0.6),  # horizontal, differential
    (0.4, 1.0, 0.8, 0.6),  # vertical, differential
    (0.05, 0.7, 0.15, 0.8),  # gimbal
    (0.1, 0.0, 1.0, 0.0),  # level camera
    (5.0, 0.0, 0.2, 0.8),  # heading of the gimbal, in degrees
]
_HORIZONTAL, _VERTICAL, _RTK, _GIMBAL, _LEVEL, _HEADING = 0, 1, 2, 4, 5, 6
# A compass is off by degrees for as long as a flight lasts, and changes slowly.
_HEADING_TIME_S = 1000.0


@dataclass(frozen=True, eq=False)
class FitState:
    """Current values: ``x_world = scale * rotation @ x_model + center`` on centred model coordinates.

    offsets_m : (F,) height of each flight's zero above the first's; gimbal_deg : (F, 3) constant error
    of each flight's gimbal about the camera's axes; level_deg : (F,) mean roll where no gimbal angles are.
    """

    rotation: np.ndarray
    scale: float
    center: np.ndarray
    offsets_m: np.ndarray
    gimbal_deg: np.ndarray
    level_deg: np.ndarray

    def moved(self, step: np.ndarray) -> FitState:
        """After a step (P,) of all parameters."""
        f = len(self.offsets_m)
        return FitState(
            rotations_from_vectors(step[3:6]) @ self.rotation,
            self.scale * float(np.exp(step[6])),
            self.center + step[:3],
            self.offsets_m + step[SHARED : SHARED + f],
            self.gimbal_deg + step[SHARED + f : SHARED + 4 * f].reshape(f, 3),
            self.level_deg + step[SHARED + 4 * f :],
        )

    @property
    def nuisance(self) -> np.ndarray:
        """(5 F,) parameters beside the similarity."""
        return np.concatenate([self.offsets_m, self.gimbal_deg.ravel(), self.level_deg])


@dataclass(frozen=True, eq=False)
class Problem:
    """Frames, what was observed of them, and which observation has which noise.

    model : (N, 3) camera centres, centred and of unit size; cam_from_model : (N, 3, 3);
    kind, frame : (M,) what each observation is, in the order of `chains`.
    """

    model: np.ndarray
    cam_from_model: np.ndarray
    fixes: Fixes
    use_level: np.ndarray
    options: GeoregisterOptions
    chains: Chains
    kind: np.ndarray
    frame: np.ndarray

    @classmethod
    def build(
        cls,
        model: np.ndarray,
        cam_from_model: np.ndarray,
        fixes: Fixes,
        use_level: np.ndarray,
        options: GeoregisterOptions,
    ) -> Problem:
        """From centred model coordinates; use_level (N,) bool: frames whose roll is taken as about zero."""
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
        # East and north, and the gimbal's two angles, are outliers together; a height on its own.
        twin = np.array([0, 0, 1, 2, 2, 3, 4])[kind] * len(model) + frame
        tau = np.where(kind == Kind.HEADING, _HEADING_TIME_S, options.correlation_time_s)
        chains, order = Chains.build(chain, fixes.time_s[frame], tau, group, unit, twin)
        return cls(
            model, cam_from_model, fixes, use_level, options, chains, kind[order], frame[order]
        )

    def levels(self) -> Levels:
        """Noise levels before the data."""
        return Levels.from_table(_TABLE)

    def conservative(self, levels: Levels) -> Levels:
        """Levels for deciding what the data determine: fixes may agree by luck or by filtering."""
        floor_bias = np.array([0.5, 0.5, 0.2, 0.2, 0.0, 0.0, 0.0])
        floor_white = np.array([0.3, 0.3, 0.7, 0.7, 0.2, 0.0, 0.2])
        return levels.at_least(floor_bias, floor_white)

    def start(self, world_from_model: Similarity, inlier: np.ndarray) -> FitState:
        """State of a first similarity; vertical offsets from its inliers' (N,) median heights."""
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
        )

    def linearise(
        self, state: FitState, offset_sigma_m: np.ndarray, bias_weight: np.ndarray
    ) -> Linear:
        """Residuals and Jacobian at a state.

        offset_sigma_m : (F,) of the vertical offsets about zero; bias_weight : (F,) robust weights of the
        flights' gimbal biases.
        """
        residual, jacobian = self._all_rows(state)
        f = len(self.fixes.flights)
        bias = np.sqrt(1 / bias_weight) * self.options.gimbal_bias_deg
        precision = np.concatenate(
            [
                np.array([0.0, 0.0, 0.0, *[_WEAK_PRECISION] * 4]),
                1 / offset_sigma_m**2,
                1 / np.repeat(bias, 3) ** 2,
                np.full(f, 1 / self.options.level_camera_sigma_deg**2),
            ]
        )
        value = np.concatenate([np.zeros(SHARED), state.nuisance])
        if not self.fixes.has_heights:
            precision[2], value[2] = 1 / _FREE_HEIGHT_M**2, state.center[2]
        rows = self.kind, self.frame
        return Linear(residual[rows], jacobian[rows], precision, value)

    def _all_rows(self, state: FitState) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (7, N) and their Jacobian (7, N, P), NaN where nothing was observed."""
        n, f = len(self.model), len(self.fixes.flights)
        flight, every = self.fixes.flight, np.arange(n)
        residual: np.ndarray = np.full((len(Kind), n), np.nan)
        jacobian: np.ndarray = np.zeros((len(Kind), n, SHARED + 5 * f))
        lever = state.scale * self.model @ state.rotation.T
        residual[:3] = (self.fixes.enu_m - lever - state.center).T
        residual[2] += state.offsets_m[flight]
        for k in range(3):
            jacobian[k, :, k] = 1.0
            jacobian[k, :, 6] = lever[:, k]
        # omega x lever
        x, y, z = lever.T
        jacobian[0, :, 4], jacobian[0, :, 5] = z, -y
        jacobian[1, :, 3], jacobian[1, :, 5] = -z, x
        jacobian[2, :, 3], jacobian[2, :, 4] = y, -x
        jacobian[2, every, SHARED + flight] = -1.0

        cam_from_world = self.cam_from_model @ state.rotation.T
        up = cam_from_world[:, :, 2]
        # Rotation in degrees, about the camera's axes, from where up is to where the gimbal has it.
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
        """(7, N) residuals of all kinds; NaN where nothing was observed."""
        residual = self._all_rows(state)[0]
        residual[Kind.LEVEL] = np.where(self.use_level, residual[Kind.LEVEL], np.nan)
        return residual

    def without_level(self) -> Problem:
        """The same problem on measurements alone."""
        return self.build(
            self.model,
            self.cam_from_model,
            self.fixes,
            np.zeros_like(self.use_level),
            self.options,
        )

    def on_frames(self, mask: np.ndarray) -> Problem:
        """The same problem on the observations of some frames (N,) bool."""
        return self.build(
            self.model,
            self.cam_from_model,
            self.fixes.only(mask),
            self.use_level & mask,
            self.options,
        )


def _tilt_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit axes (N, 3) across the directions of up (N, 3) in camera axes: pitch's and roll's."""
    # A camera on its side has up along its x axis: z then takes its place.
    sideways = np.abs(up[:, :1]) > 0.9
    axis = np.where(sideways, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = axis - np.einsum("ni,ni->n", axis, up)[:, None] * up
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(up, first)


def _turn_about_up_deg(attitude: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """Degrees (N,) about up by which the world would have to turn for cam_from_world to be the attitude."""
    known = np.isfinite(attitude).all(axis=(1, 2))
    turn = np.full(len(attitude), np.nan)
    quats = quats_from_rotations(attitude[known].transpose(0, 2, 1) @ cam_from_world[known])
    # The twist about z of a rotation that may tilt a little too.
    angle = np.rad2deg(2 * np.arctan2(quats[:, 3], quats[:, 0]))
    turn[known] = (angle + 180.0) % 360.0 - 180.0
    return turn
