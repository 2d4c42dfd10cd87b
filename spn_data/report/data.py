"""Content of the report as plain values."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from spn_data.coverage.nearest_frame import Stratum
from spn_data.geometry.pose import Poses
from spn_data.georegistration.result import GeoFit
from spn_data.labels.labels import LabelStatus
from spn_data.labels.map_points import MapPoints
from spn_data.report.expected import ExpectedPlan
from spn_data.report.network_state import NetworkState, RecordedFlight
from spn_data.report.photogrammetry_facts import Photogrammetry
from spn_data.report.run_facts import RunFacts
from spn_data.split import audit
from spn_data.split.groups import Split
from spn_data.storage.stage_record import StageRecord

REGISTERED, FAILED = LabelStatus.REGISTERED.value, LabelStatus.FAILED.value
STRATA = tuple(stratum.value for stratum in Stratum)


@dataclass(frozen=True, eq=False)
class FrameTable:
    """Status and pose of N frames, sorted by sequence and time; unknown values are NaN.

    Attributes
    ----------
    names, sequences, cameras : ndarray of str, shape (N,)
        Image name, sequence and camera of each frame.
    evaluation : ndarray of bool, shape (N,)
        Whether the frame belongs to an evaluation sequence, not to the map.
    tracked : ndarray of bool, shape (N,)
        Whether the frame is not among the chosen frames.
    time_s : ndarray, shape (N,)
        Time since the first frame of the sequence.
    status : ndarray of str, shape (N,)
        "registered", "failed", "skipped" or "unreadable".
    reason : ndarray of str, shape (N,)
        Why the frame has this status.
    poses : Poses
        Poses of the registered frames.
    sigma_m, sigma_deg : ndarray, shape (N,)
        Root of the trace of the position and rotation covariance, 1 sigma.
    inliers : ndarray of int, shape (N,)
        Number of map points that support the pose.
    error_px : ndarray, shape (N,)
        RMS reprojection error.
    gnss_m : ndarray, shape (N, 3)
        GNSS fix minus pose, east, north, up.
    gnss_outlier : ndarray of bool, shape (N,)
        Whether the fix is an outlier.
    stratum, group : ndarray of str, shape (N,)
        Coverage stratum and group of the split; empty if there is none.
    """

    names: np.ndarray
    sequences: np.ndarray
    cameras: np.ndarray
    evaluation: np.ndarray
    tracked: np.ndarray
    time_s: np.ndarray
    status: np.ndarray
    reason: np.ndarray
    poses: Poses
    sigma_m: np.ndarray
    sigma_deg: np.ndarray
    inliers: np.ndarray
    error_px: np.ndarray
    gnss_m: np.ndarray
    gnss_outlier: np.ndarray
    stratum: np.ndarray
    group: np.ndarray

    def __post_init__(self) -> None:
        for column in fields(self):
            if len(getattr(self, column.name)) != len(self.names):
                raise ValueError(f"{column.name} differs in length from names")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def registered(self) -> np.ndarray:
        """Mask (N,) of the frames with a pose."""
        return self.status == REGISTERED

    @property
    def tried(self) -> np.ndarray:
        """Mask (N,) of the frames for which a pose was attempted."""
        return self.registered | (self.status == FAILED)

    def select(self, index: np.ndarray) -> FrameTable:
        """Return the rows of an index or mask (N,)."""
        return FrameTable(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @classmethod
    def concatenate(cls, parts: list[FrameTable]) -> FrameTable:
        """Concatenate the rows of several tables."""
        columns: dict[str, Any] = {
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(cls)
            if f.name != "poses"
        }
        return cls(**columns, poses=Poses.concatenate(part.poses for part in parts))

    @staticmethod
    def no_facts(n: int) -> dict[str, np.ndarray]:
        """Return the columns filled by `with_facts` for N frames, all unknown."""
        return {
            "gnss_m": np.full((n, 3), np.nan),
            "gnss_outlier": np.zeros(n, bool),
            "stratum": np.full(n, "", dtype="<U1"),
            "group": np.full(n, "", dtype="<U1"),
        }

    def with_facts(
        self,
        residuals: Mapping[str, tuple[np.ndarray, bool]],
        strata: Mapping[str, str],
        groups: Mapping[str, str],
    ) -> FrameTable:
        """Return the frames with facts added by name: (GNSS residual, outlier), stratum, group."""
        names = self.names.tolist()
        unknown = (np.full(3, np.nan), False)
        fixes = [residuals.get(name, unknown) for name in names]
        return replace(
            self,
            gnss_m=np.array([residual for residual, _ in fixes], dtype=np.float64).reshape(-1, 3),
            gnss_outlier=np.array([outlier for _, outlier in fixes], dtype=bool),
            stratum=np.array([strata.get(name, "") for name in names], dtype=np.str_),
            group=np.array([groups.get(name, "") for name in names], dtype=np.str_),
        )

    def reasons(self, mask: np.ndarray) -> list[tuple[str, int]]:
        """Count the reasons of failed frames in a mask, most frequent first; numbers are replaced by N."""
        failed = mask & (self.status == FAILED)
        kinds = [re.sub(r"\d+(\.\d+)?", "N", reason) for reason in self.reason[failed].tolist()]
        return Counter(kinds).most_common()


@dataclass(frozen=True)
class StageFacts:
    """An existing stage.

    Attributes
    ----------
    record : StageRecord
        Record of the stage.
    stale : str or None
        Why the stage no longer matches its inputs; None if it does.
    command : str
        Command that makes the stage; words in capitals are placeholders for the user's arguments.
    """

    record: StageRecord
    stale: str | None
    command: str


@dataclass(frozen=True)
class PlaceToFly:
    """A camera pose missing in the mapping flights.

    Attributes
    ----------
    east_north_up_m : tuple of float
        Position in the world.
    lat_lon_deg : tuple of float
        Position in WGS84.
    heading_deg, pitch_deg : float
        Viewing direction.
    frames : int
        Number of evaluation frames it would help.
    """

    east_north_up_m: tuple[float, float, float]
    lat_lon_deg: tuple[float, float]
    heading_deg: float
    pitch_deg: float
    frames: int


@dataclass(frozen=True)
class CoverageFacts:
    """How well mapping frames cover other frames.

    Attributes
    ----------
    strata : dict of str to dict of str to int
        Number of frames by stratum for each sequence; frames without a pose are counted as "failed".
    fly_again : tuple of PlaceToFly
        Missing mapping views, in the order of a short path.
    limits : str
        Limits of the strata in words.
    stale : str or None
        Why the coverage no longer matches the area; None if it does.
    """

    strata: dict[str, dict[str, int]]
    fly_again: tuple[PlaceToFly, ...]
    limits: str
    stale: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportData:
    """State of an area at one moment.

    Attributes
    ----------
    title, path : str
        Name and path of the area's folder.
    made : str
        Time of the report in UTC, ISO 8601.
    version : str
        Version of the program.
    units : str
        "m", or "model" if metres, north and up are unknown.
    stages : tuple of StageFacts
        Existing stages in processing order.
    model_record : StageRecord or None
        Record of the stage with the model.
    geo : GeoFit or None
        Georegistration; None if there is none.
    frames : FrameTable
        All frames.
    points : MapPoints or None
        Points of the map.
    fov_tan : dict of str to (float, float)
        Tangents of half the horizontal and vertical field of view by camera.
    coverage, plan : CoverageFacts or None
        Coverage of the evaluation sequences and of planned waypoints.
    split : Split or None
        Split of the frames.
    audit : tuple of AuditFinding or None
        Findings of the audit of the split.
    evaluation_records : dict of str to StageRecord
        Records of the stages of evaluation sequences, by name.
    runs : tuple of RunFacts
        Evaluated networks.
    broken_runs : tuple of str
        Why other runs cannot be shown.
    trained : tuple of NetworkState
        Trained networks, the newest first.
    expect_low : frozenset of str
        Evaluation sequences that are declared to be far from the map.
    recorded : RecordedFlight or None
        An evaluation flight whose video is known.
    plans, broken_plans : tuple of ExpectedPlan, tuple of str
        What is expected of planned waypoints, and why others cannot be shown.
    photogrammetry : Photogrammetry or None
        None if there is no model.
    """

    title: str
    path: str
    made: str
    version: str
    units: str
    stages: tuple[StageFacts, ...]
    model_record: StageRecord | None
    geo: GeoFit | None
    frames: FrameTable
    points: MapPoints | None
    fov_tan: dict[str, tuple[float, float]] = field(default_factory=dict)
    coverage: CoverageFacts | None = None
    plan: CoverageFacts | None = None
    split: Split | None = None
    audit: tuple[audit.AuditFinding, ...] | None = None
    evaluation_records: dict[str, StageRecord] = field(default_factory=dict)
    runs: tuple[RunFacts, ...] = ()
    broken_runs: tuple[str, ...] = ()
    trained: tuple[NetworkState, ...] = ()
    expect_low: frozenset[str] = frozenset()
    recorded: RecordedFlight | None = None
    plans: tuple[ExpectedPlan, ...] = ()
    broken_plans: tuple[str, ...] = ()
    photogrammetry: Photogrammetry | None = None

    @property
    def evaluation_sequences(self) -> tuple[str, ...]:
        """Sorted names of the evaluation sequences."""
        return tuple(sorted(set(self.frames.sequences[self.frames.evaluation].tolist())))
