"""Rolling shutter and electronic stabilisation: found in a model's residuals, with the size of the effect."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.least_squares import POSE
from spn_data.geometry.pose import Poses
from spn_data.reconstruction.frame_jitter import frame_jitter
from spn_data.reconstruction.residual_fit import (
    LensObservations,
    Partialled,
    linearize,
    partial_out,
    solve_spd,
)

_KINDS = ("zoom", "shear", "stretch")
_PLAUSIBLE_READOUT_S = 0.07  # slowest sensors of drones take about 50 ms for a frame


@dataclass(frozen=True, kw_only=True)
class ShutterOptions:
    """What counts as known motion and as a finding, and how much work to do."""

    max_gap_s: float = 3.0  # between frames whose motion is interpolated
    min_frames: int = 10  # of a sequence, with known motion, to judge the shutter
    max_block_frames: int = 120  # linearised together; time grows with its square
    max_observations_per_frame: int = 300  # used; more adds time, not certainty
    min_sigmas: float = 5.0  # of a finding
    min_displacement_px: float = 0.3  # of a finding, 95 % of points move less


@dataclass(frozen=True)
class ShutterDiagnosis:
    """What residuals tell of the shutter and the stabilisation of one sequence and camera.

    frames : used. NaN is what the flight does not tell.
    readout_s, readout_sigma_s : from first to last row; negative from the last to the first.
    displacement_rms_px, displacement_p95_px : by which the readout moves points.
    explained_share : of the squared residuals, by the readout.
    pose_shift, pose_turn_deg : RMS by which the readout pushed camera centres (the model's unit) and
    rotations, but for what is common to all.
    zoom_rms, shear_rms, stretch_rms : of the frames' own zoom, shear and stretch about the image's middle,
    beyond noise; zoom_sigmas, shear_sigmas, stretch_sigmas : how certain they are.
    jitter_p95_px : by which those of `jitters` move 95 % of the points at most.
    zoom_drift, zoom_drift_sigma : relative change of the focal length from the first frame to the last.
    rolls : the readout is a finding; jitters : the findings among zoom, shear and stretch; drifts : the
    drift is a finding.
    """

    sequence: str
    camera_id: int
    frames: int
    readout_s: float
    readout_sigma_s: float
    displacement_rms_px: float
    displacement_p95_px: float
    explained_share: float
    pose_shift: float
    pose_turn_deg: float
    zoom_rms: float
    shear_rms: float
    stretch_rms: float
    zoom_sigmas: float
    shear_sigmas: float
    stretch_sigmas: float
    jitter_p95_px: float
    zoom_drift: float
    zoom_drift_sigma: float
    rolls: bool
    jitters: tuple[str, ...]
    drifts: bool

    def counts(self) -> dict[str, object]:
        """As JSON holds it: None for what is not known."""
        values: dict[str, object] = {}
        for name, value in asdict(self).items():
            if isinstance(value, float):
                value = float(f"{value:.4g}") if np.isfinite(value) else None
            values[name] = list(value) if isinstance(value, tuple) else value
        return values

    def tell(self, metres_per_unit: float | None = None) -> str:
        """One sentence to the user for all that was found, or nothing.

        metres_per_unit : of the model, where it is georeferenced.
        """
        found = []
        if self.rolls:
            found.append(self._tell_readout(metres_per_unit))
        if self.jitters:
            found.append(self._tell_jitter())
        if self.drifts:
            found.append(
                f"the focal length drifts by {_plain(100 * self.zoom_drift)} % (sigma "
                f"{_plain(100 * self.zoom_drift_sigma, 1)} %) from the first frame to the last; "
                "fix zoom and focus"
            )
        return f"{self.sequence}: {'; '.join(found)}" if found else ""

    def _tell_readout(self, metres_per_unit: float | None) -> str:
        direction = "first to last" if self.readout_s > 0 else "last to first"
        text = (
            f"rolling shutter of about {1000 * abs(self.readout_s):.0f} ms (sigma "
            f"{_plain(1000 * self.readout_sigma_s, 1)} ms) from {direction} row moves points by up to "
            f"{self.displacement_p95_px:.1f} px"
        )
        if abs(self.readout_s) > _PLAUSIBLE_READOUT_S:
            text += " (sensors are faster: stabilisation or wrong times may add to it)"
        off = f"{_plain(self.pose_turn_deg)} degrees"
        if metres_per_unit is not None:
            off = f"{_plain(100 * metres_per_unit * self.pose_shift)} cm and {off}"
        return (
            f"{text}; poses may be off by {off}; "
            "fly slower or film with a mechanical or global shutter"
        )

    def _tell_jitter(self) -> str:
        sizes = {"zoom": self.zoom_rms, "shear": self.shear_rms, "stretch": self.stretch_rms}
        kinds = " and ".join(f"{kind} by {_plain(100 * sizes[kind])} %" for kind in self.jitters)
        return (
            f"frames differ in {kinds} (RMS), which moves points by up to {self.jitter_p95_px:.1f} px, "
            "as electronic stabilisation does; switch it off when filming"
        )


def _plain(value: float, digits: int = 2) -> str:
    """A number of some significant digits and without an exponent."""
    return np.format_float_positional(value, precision=digits, fractional=False, trim="-")


def diagnose_shutter(
    scene: Scene,
    observations: MapObservations,
    sequences: np.ndarray,
    time_s: np.ndarray,
    options: ShutterOptions | None = None,
) -> tuple[ShutterDiagnosis, ...]:
    """What the residuals of a model tell of each sequence and camera that has enough frames.

    sequences (N,) str and time_s (N,) belong to scene.names. See docs/shutter.md for the method.
    """
    options = options or ShutterOptions()
    if len(sequences) != len(scene.names) or len(time_s) != len(scene.names):
        raise ValueError(f"{len(sequences)} sequences for {len(scene.names)} images")
    if not np.isfinite(time_s).all():
        raise ValueError("every image needs a time")
    found = []
    for sequence in sorted(set(sequences.tolist())):
        for camera_id in sorted(set(scene.camera_ids[sequences == sequence].tolist())):
            rows = np.flatnonzero((sequences == sequence) & (scene.camera_ids == camera_id))
            rows = rows[np.argsort(time_s[rows], kind="stable")]
            diagnosis = _diagnose(scene, observations, rows, time_s[rows], str(sequence), options)
            if diagnosis is not None:
                found.append(diagnosis)
    return tuple(found)


def world_twists(poses: Poses, time_s: np.ndarray, *, max_gap_s: float) -> np.ndarray:
    """Velocity (N, 6) of a still world in the camera frame of moving cameras: units and radians per second.

    poses (N) in order of time_s (N,). NaN where the motion is not known: beside a gap of more than
    max_gap_s, at equal times, and at the ends.
    """
    twists = np.full((len(poses), 6), np.nan)
    rotations = poses.rotations
    gaps = np.flatnonzero((np.diff(time_s) <= 0) | (np.diff(time_s) > max_gap_s)) + 1
    for run in np.split(np.arange(len(poses)), gaps):
        if len(run) < 4:
            continue
        inner = run[1:-1]
        moves = CubicSpline(time_s[run], poses.centers[run])(time_s[inner], 1)
        turns = CubicSpline(time_s[run], rotations[run])(time_s[inner], 1)
        twists[inner, :3] = -np.einsum("nij,nj->ni", rotations[inner], moves)
        rates = turns @ np.swapaxes(rotations[inner], 1, 2)
        rates = (rates - np.swapaxes(rates, 1, 2)) / 2
        twists[inner, 3:] = np.stack([rates[:, 2, 1], rates[:, 0, 2], rates[:, 1, 0]], axis=1)
    return twists


def _diagnose(
    scene: Scene,
    seen: MapObservations,
    rows: np.ndarray,
    time_s: np.ndarray,
    sequence: str,
    options: ShutterOptions,
) -> ShutterDiagnosis | None:
    twists = world_twists(scene.poses[rows], time_s, max_gap_s=options.max_gap_s)
    known = np.isfinite(twists).all(axis=1)
    is_known = bool(known.sum() >= options.min_frames)
    if is_known:
        rows, time_s, twists = rows[known], time_s[known], twists[known]
    else:
        twists = np.zeros_like(twists)
    if len(rows) < options.min_frames:
        return None
    span = float(np.ptp(time_s))
    trend = (time_s - time_s.mean()) / span if span > 0 else np.zeros(len(rows))
    parts = np.array_split(np.arange(len(rows)), -(-len(rows) // options.max_block_frames))
    blocks = []
    for part in parts:
        limit = options.max_observations_per_frame * len(part)
        block = linearize(
            scene, seen, rows[part], twists[part], trend[part], max_observations=limit
        )
        if block is not None:
            blocks.append((block, partial_out(block)))
    if not blocks:
        return None
    effects, sigmas, share = _fit_effects(blocks)
    readout_s = float(effects[0]) if is_known else 0.0
    moved = np.concatenate(
        [np.linalg.norm(b.effects[:, :, 0], axis=1) * abs(readout_s) for b, _ in blocks]
    )
    shift, turn = _pose_shift(scene, blocks, readout_s)
    p95 = float(np.percentile(moved, 95))
    rolls = (
        is_known
        and abs(readout_s) > options.min_sigmas * float(sigmas[0])
        and p95 > options.min_displacement_px
    )
    jitter, jitter_sigmas = frame_jitter(blocks, readout_s)
    sure = jitter_sigmas > options.min_sigmas
    own = np.concatenate([b.per_frame[:, :, POSE:] for b, _ in blocks])
    squares = ((own * np.where(sure, jitter, 0.0)) ** 2).sum(axis=(1, 2))
    jitter_px = 2 * float(np.sqrt(squares.mean()))
    # Shakes between two frames look like jitter where rows are read one after the other.
    jitters = jitter_px > max(options.min_displacement_px, p95 if rolls else 0.0)
    zooms = np.concatenate([b.per_frame[:, :, POSE] for b, _ in blocks])
    drift, drift_sigma = float(effects[1]), float(sigmas[1])
    drift_px = abs(drift) / 2 * float(np.percentile(np.linalg.norm(zooms, axis=1), 95))
    unknown = 1.0 if is_known else float("nan")
    return ShutterDiagnosis(
        sequence=sequence,
        camera_id=int(scene.camera_ids[rows[0]]),
        frames=sum(len(b.frames) for b, _ in blocks),
        readout_s=unknown * readout_s,
        readout_sigma_s=unknown * float(sigmas[0]),
        displacement_rms_px=unknown * float(np.sqrt(np.mean(moved**2))),
        displacement_p95_px=unknown * p95,
        explained_share=unknown * share,
        pose_shift=unknown * shift,
        pose_turn_deg=unknown * turn,
        zoom_rms=float(jitter[0]),
        shear_rms=float(jitter[1]),
        stretch_rms=float(jitter[2]),
        zoom_sigmas=float(jitter_sigmas[0]),
        shear_sigmas=float(jitter_sigmas[1]),
        stretch_sigmas=float(jitter_sigmas[2]),
        jitter_p95_px=jitter_px,
        zoom_drift=drift,
        zoom_drift_sigma=drift_sigma,
        rolls=rolls,
        jitters=tuple(kind for kind, is_sure in zip(_KINDS, sure, strict=True) if is_sure)
        if jitters
        else (),
        drifts=abs(drift) > options.min_sigmas * drift_sigma
        and drift_px > options.min_displacement_px,
    )


def _fit_effects(
    blocks: list[tuple[LensObservations, Partialled]],
) -> tuple[np.ndarray, np.ndarray, float]:
    """Effects (E,), their sigmas (E,), and the share of squared residuals that the first explains.

    Sigmas are from the scatter between frames, with neighbours in time correlated (Newey and West 1987),
    for errors within a frame and in points that neighbours share are not independent; and never below
    those of independent errors, for the scatter of few frames can be small by chance.
    """
    information = sum(
        np.einsum("m,mki,mkj->ij", b.weights, p.effects, p.effects) for b, p in blocks
    )
    pull = sum(np.einsum("m,mki,mk->i", b.weights, p.effects, p.residuals_px) for b, p in blocks)
    effects = -solve_spd(information, pull[:, None])[:, 0]
    meat = np.zeros_like(information)
    before = after = spread = 0.0
    degrees = 0
    for b, p in blocks:
        left = p.residuals_px + p.effects @ effects
        scores = np.zeros((len(b.frames), len(effects)))
        np.add.at(scores, b.frame, np.einsum("m,mki,mk->mi", b.weights, p.effects, left))
        both = scores.T @ scores
        for lag, weight in ((1, 2 / 3), (2, 1 / 3)):
            cross = scores[lag:].T @ scores[:-lag]
            both += weight * (cross + cross.T)
        meat += both
        degrees += b.degrees_of_freedom
        before += float(b.weights @ (p.residuals_px**2).sum(axis=1))
        spread += float(b.weights @ (left**2).sum(axis=1))
        with_readout = p.residuals_px + p.effects[:, :, 0] * effects[0]
        after += float(b.weights @ (with_readout**2).sum(axis=1))
    inverse = solve_spd(information, np.eye(len(effects)))
    independent = spread / degrees * np.diag(inverse)
    sigmas = np.sqrt(np.maximum(np.diag(inverse @ meat @ inverse), independent))
    return effects, sigmas, max(0.0, 1 - after / before) if before > 0 else 0.0


def _pose_shift(
    scene: Scene, blocks: list[tuple[LensObservations, Partialled]], readout_s: float
) -> tuple[float, float]:
    """RMS of centres (units) and rotations (degrees) that the readout moved, but for a common similarity."""
    shifts, turns = [], []
    for block, partialled in blocks:
        poses = scene.poses[block.frames]
        moved = readout_s * partialled.pose_per_effect[:, :, 0]
        back = np.swapaxes(poses.rotations, 1, 2)
        shift = -np.einsum("nij,nj->ni", back, moved[:, :3])
        turn = np.einsum("nij,nj->ni", back, moved[:, 3:])
        arm = poses.centers - poses.centers.mean(axis=0)
        eye = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
        gauge = np.concatenate([eye, np.cross(eye, arm[:, None]), arm[:, :, None]], axis=2)
        common = np.linalg.lstsq(gauge.reshape(-1, 7), shift.ravel(), rcond=1e-6)[0]
        shifts.append(shift - gauge @ common)
        turns.append(turn - np.median(turn, axis=0))
    squares = [float((np.concatenate(v) ** 2).sum(axis=1).mean()) for v in (shifts, turns)]
    return float(np.sqrt(squares[0])), float(np.rad2deg(np.sqrt(squares[1])))
