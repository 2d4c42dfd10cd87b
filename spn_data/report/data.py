"""What the report shows, gathered as plain values."""

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
from spn_data.split import audit
from spn_data.split.groups import Split
from spn_data.storage.stage_record import StageRecord

REGISTERED, FAILED = LabelStatus.REGISTERED.value, LabelStatus.FAILED.value
STRATA = tuple(stratum.value for stratum in Stratum)


@dataclass(frozen=True, eq=False)
class FrameTable:
    """N frames with what became of each, in the order of sequence and time. What is not known is NaN.

    names, sequences, cameras : (N,) str; evaluation : (N,) bool, of an evaluation sequence, not of the map;
    tracked : (N,) bool, not among the chosen frames; time_s : (N,) since the sequence's first frame.
    status : (N,) str, "registered", "failed", "skipped" or "unreadable"; reason : (N,) str.
    poses : of the registered; sigma_m, sigma_deg : (N,) root of the trace of their covariance, 1 sigma.
    inliers : (N,) int, map points that the pose rests on; error_px : (N,) root mean square residual.
    gnss_m : (N, 3) fix minus pose, east north up; gnss_outlier : (N,) bool.
    stratum : (N,) str, coverage; group : (N,) str, of the split; empty where there is none.
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
        """(N,) bool."""
        return self.status == REGISTERED

    @property
    def tried(self) -> np.ndarray:
        """(N,) bool: a pose was looked for."""
        return self.registered | (self.status == FAILED)

    def select(self, index: np.ndarray) -> FrameTable:
        """The rows of an index or mask (N,)."""
        return FrameTable(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @classmethod
    def concatenate(cls, parts: list[FrameTable]) -> FrameTable:
        """The rows of several, one after the other."""
        columns: dict[str, Any] = {
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(cls)
            if f.name != "poses"
        }
        return cls(**columns, poses=Poses.concatenate(part.poses for part in parts))

    @staticmethod
    def no_facts(n: int) -> dict[str, np.ndarray]:
        """The columns of `with_facts`, for N frames of which nothing of that kind is known."""
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
        """The same frames with what is known of them by name: (GNSS residual, outlier), stratum, group."""
        names = self.names.tolist()
        unknown = (np.full(3, np.nan), False)
        found = [residuals.get(name, unknown) for name in names]
        return replace(
            self,
            gnss_m=np.array([residual for residual, _ in found], dtype=np.float64).reshape(-1, 3),
            gnss_outlier=np.array([outlier for _, outlier in found], dtype=bool),
            stratum=np.array([strata.get(name, "") for name in names], dtype=np.str_),
            group=np.array([groups.get(name, "") for name in names], dtype=np.str_),
        )

    def reasons(self, mask: np.ndarray) -> list[tuple[str, int]]:
        """Why frames of a mask failed, most frequent first; figures in a reason are shown as N."""
        failed = mask & (self.status == FAILED)
        kinds = [re.sub(r"\d+(\.\d+)?", "N", reason) for reason in self.reason[failed].tolist()]
        return Counter(kinds).most_common()


@dataclass(frozen=True)
class StageFacts:
    """A stage that stands; stale : why it no longer fits what it was made from, None where it does.

    command : that makes it; words in capitals stand for what the user gave.
    """

    record: StageRecord
    stale: str | None
    command: str


@dataclass(frozen=True)
class PlaceToFly:
    """A view that mapping lacks: of a camera there, and how many evaluation frames it would help."""

    east_north_up_m: tuple[float, float, float]
    lat_lon_deg: tuple[float, float]
    heading_deg: float
    pitch_deg: float
    frames: int


@dataclass(frozen=True)
class CoverageFacts:
    """How mapping covers other frames.

    strata : by sequence, number of frames by stratum, those without a pose as "failed"; fly_again : in the
    order of a short path; limits : of the strata, in words; stale : why it no longer fits the area, or None.
    """

    strata: dict[str, dict[str, int]]
    fly_again: tuple[PlaceToFly, ...]
    limits: str
    stale: str | None = None


@dataclass(frozen=True)
class MethodErrors:
    """What a network, or what stands beside it, is worth on one group; None is unknown, or no number.

    position, rotation_deg : median, mean and p95; within : (limit, degrees, share); signed : (axis, median,
    estimated minus true); ratio : of the stated covariances, 1 is right.
    """

    frames: int
    located: int
    position: tuple[float | None, ...]
    rotation_deg: tuple[float | None, ...]
    within: tuple[tuple[float, float, float], ...]
    signed: tuple[tuple[str, float | None], ...]
    ratio: float | None


@dataclass(frozen=True)
class NetworkFacts:
    """A trained network; None where nothing tells. checkpoint : fingerprint of what was judged; images,
    minutes : of the whole training; kept_minutes : of it, when this network was the best so far."""

    kind: str
    checkpoint: str
    parameters: int | None
    size_bytes: int | None
    images: int | None
    minutes: float | None
    kept_minutes: float | None
    ms_an_image: float | None


@dataclass(frozen=True)
class Figure:
    """caption : in words; width_px : that it was drawn for; svg : the file's bytes."""

    caption: str
    width_px: int
    svg: bytes


@dataclass(frozen=True, kw_only=True)
class RunFacts:
    """What `spn-model evaluate` left in one folder of runs/.

    networks : by name; is_outdated : one was trained on since. groups : role and methods, by name of the
    group; dataset : fingerprint of what they were judged on; is_current : that is the area's data set of now.
    published : rows (network, group, position, rotation in degrees) of the paper. left_out : figures not
    shown.
    """

    name: str
    units: str
    dataset: str
    is_current: bool
    is_outdated: bool
    networks: dict[str, NetworkFacts]
    groups: dict[str, tuple[str, dict[str, MethodErrors]]]
    retrieval: dict[str, str]
    published: tuple[tuple[str, str, float, float], ...]
    notes: tuple[str, ...]
    figures: tuple[Figure, ...]
    left_out: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportData:
    """An area at one moment.

    title : name of its folder; path : of it; made : UTC, ISO 8601; units : "m", or "model" where nothing is
    known of metres, north and up. stages : those that stand, in the order of work.
    fov_tan : by camera, tangents of half the horizontal and vertical field of view.
    evaluation_records : of the stages of evaluation sequences, by name. coverage : of these; plan : of
    planned waypoints. runs : networks that were judged; broken_runs : why others cannot be shown.
    """

    title: str
    path: str
    made: str
    version: str
    units: str
    stages: tuple[StageFacts, ...]
    frames_record: StageRecord | None
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

    @property
    def evaluation_sequences(self) -> tuple[str, ...]:
        """Names, sorted."""
        return tuple(sorted(set(self.frames.sequences[self.frames.evaluation].tolist())))
