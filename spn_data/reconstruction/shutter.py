"""Detection and size of rolling shutter and electronic stabilisation in a model's residuals."""

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
_PLAUSIBLE_READOUT_S = 0.07  # the slowest drone sensors need about 50 ms per frame


@dataclass(frozen=True, kw_only=True)
class ShutterOptions:
    """Thresholds of the diagnosis and limits on its cost.

    Attributes
    ----------
    max_gap_s : float
        Maximum time between frames for interpolating the motion.
    min_frames : int
        Minimum number of frames with known motion to judge the shutter of a sequence.
    max_block_frames : int
        Maximum number of frames linearized together; time grows with its square.
    max_observations_per_frame : int
        Maximum number of observations used; more take time without improving the result.
    min_sigmas : float
        Minimum significance of a finding.
    min_displacement_px : float
        Minimum size of a finding: 95 % of the points move less than the reported displacement.
    """

    max_gap_s: float = 3.0
    min_frames: int = 10
    max_block_frames: int = 120
    max_observations_per_frame: int = 300
    min_sigmas: float = 5.0
    min_displacement_px: float = 0.3


@dataclass(frozen=True)
class ShutterDiagnosis:
    """Diagnosis of shutter and stabilisation for one sequence and camera. Undetermined values are NaN.

    Attributes
    ----------
    sequence : str
    camera_id : int
    frames : int
        Number of frames used.
    readout_s, readout_sigma_s : float
        Readout time from first to last row; negative if read from last to first.
    displacement_rms_px, displacement_p95_px : float
        Displacement of the points by the readout.
    explained_share : float
        Share of the squared residuals that the readout explains.
    pose_shift, pose_turn_deg : float
        RMS displacement of camera centres (in the model's unit) and rotations by the readout, except for what
        is common to all.
    zoom_rms, shear_rms, stretch_rms : float
        Zoom, shear and stretch of single frames about the image centre, beyond noise.
    zoom_sigmas, shear_sigmas, stretch_sigmas : float
        Their significance.
    jitter_p95_px : float
        95th percentile of the point displacement by those in `jitters`.
    zoom_drift, zoom_drift_sigma : float
        Relative change of the focal length from the first frame to the last.
    rolls : bool
        Whether the readout is a finding.
    jitters : tuple of str
        Findings among zoom, shear and stretch.
    drifts : bool
        Whether the drift is a finding.
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
        """Return the values for JSON; None replaces NaN."""
        values: dict[str, object] = {}
        for name, value in asdict(self).items():
            if isinstance(value, float):
                value = float(f"{value:.4g}") if np.isfinite(value) else None
            values[name] = list(value) if isinstance(value, tuple) else value
        return values

    def describe(self, metres_per_unit: float | None = None) -> str:
        """Return one sentence for the user that lists all findings, or an empty string.

        Parameters
        ----------
        metres_per_unit : float, optional
            Scale of the model if it is georeferenced.

        Returns
        -------
        str
        """
        findings = []
        if self.rolls:
            findings.append(self._describe_readout(metres_per_unit))
        if self.jitters:
            findings.append(self._describe_jitter())
        if self.drifts:
            findings.append(
                f"the focal length drifts by {_decimal(100 * self.zoom_drift)} % (sigma "
                f"{_decimal(100 * self.zoom_drift_sigma, 1)} %) from the first frame to the last; "
                "fix zoom and focus"
            )
        return f"{self.sequence}: {'; '.join(findings)}" if findings else ""

    def _describe_readout(self, metres_per_unit: float | None) -> str:
        direction = "first to last" if self.readout_s > 0 else "last to first"
        text = (
            f"rolling shutter of about {1000 * abs(self.readout_s):.0f} ms (sigma "
            f"{_decimal(1000 * self.readout_sigma_s, 1)} ms) from {direction} row moves points by up to "
            f"{self.displacement_p95_px:.1f} px"
        )
        if abs(self.readout_s) > _PLAUSIBLE_READOUT_S:
            text += " (sensors are faster: stabilisation or wrong times may contribute)"
        off = f"{_decimal(self.pose_turn_deg)} degrees"
        if metres_per_unit is not None:
            off = f"{_decimal(100 * metres_per_unit * self.pose_shift)} cm and {off}"
        return (
            f"{text}; poses may be off by {off}; "
            "fly slower or film with a mechanical or global shutter"
        )

    def _describe_jitter(self) -> str:
        sizes = {"zoom": self.zoom_rms, "shear": self.shear_rms, "stretch": self.stretch_rms}
        kinds = " and ".join(f"{kind} by {_decimal(100 * sizes[kind])} %" for kind in self.jitters)
        return (
            f"frames differ in {kinds} (RMS), which moves points by up to {self.jitter_p95_px:.1f} px, "
            "as electronic stabilisation does; switch it off when filming"
        )


def _decimal(value: float, digits: int = 2) -> str:
    """Format a number with some significant digits and without an exponent."""
    return np.format_float_positional(value, precision=digits, fractional=False, trim="-")


def diagnose_shutter(
    scene: Scene,
    observations: MapObservations,
    sequences: np.ndarray,
    time_s: np.ndarray,
    options: ShutterOptions | None = None,
) -> tuple[ShutterDiagnosis, ...]:
    """Diagnose the shutter of each sequence and camera with enough frames from the residuals of a model.

    See docs/shutter.md for the method.

    Parameters
    ----------
    scene : Scene
    observations : MapObservations
    sequences : ndarray, shape (N,), str
        Sequence of each image, in the order of `scene.names`.
    time_s : ndarray, shape (N,)
        Time of each image in its sequence.
    options : ShutterOptions, optional

    Returns
    -------
    tuple of ShutterDiagnosis

    Raises
    ------
    ValueError
        If `sequences` or `time_s` does not match the scene, or a time is not finite.
    """
    options = options or ShutterOptions()
    if len(sequences) != len(scene.names) or len(time_s) != len(scene.names):
        raise ValueError(f"{len(sequences)} sequences for {len(scene.names)} images")
    if not np.isfinite(time_s).all():
        raise ValueError("every image needs a finite time")
    diagnoses = []
    for sequence in sorted(set(sequences.tolist())):
        for camera_id in sorted(set(scene.camera_ids[sequences == sequence].tolist())):
            rows = np.flatnonzero((sequences == sequence) & (scene.camera_ids == camera_id))
            rows = rows[np.argsort(time_s[rows], kind="stable")]
            diagnosis = _diagnose(scene, observations, rows, time_s[rows], str(sequence), options)
            if diagnosis is not None:
                diagnoses.append(diagnosis)
    return tuple(diagnoses)


def world_twists(poses: Poses, time_s: np.ndarray, *, max_gap_s: float) -> np.ndarray:
    """Return the velocity (N, 6) of a static world in the frame of a moving camera.

    The velocity is in units and radians per second. The poses (N) are in the order of time_s (N,). The
    velocity is NaN if the motion is unknown: next to a gap of more than max_gap_s, at equal times, and at the
    ends.
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
    # With a rolling shutter, vibrations between two frames look like jitter.
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
    """Return effects (E,), their sigmas (E,), and the share of squared residuals explained by the first.

    The sigmas are cluster-robust: they follow from the scatter between frames, with frames adjacent in time
    correlated (Newey and West 1987), because errors within a frame and in points that adjacent frames share
    are not independent. They are never below those of independent errors, as the scatter of few frames can be
    small by chance.
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
    """Return the RMS shift of centres (units) and rotations (degrees) by the readout, after a similarity."""
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
