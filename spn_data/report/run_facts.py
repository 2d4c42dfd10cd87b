"""Facts of the evaluation of a trained network, as the report shows them."""

from __future__ import annotations

from dataclasses import dataclass, field

from spn_data.report.fix_facts import BundleFixes


@dataclass(frozen=True)
class MethodErrors:
    """Errors of a network or a baseline on one group; None if unknown or not finite.

    Attributes
    ----------
    frames, located : int
        Number of frames, and of those with an estimated pose.
    position, rotation_deg : tuple of float or None
        Median, mean and 95th percentile of the errors.
    within : tuple of (float, float, float)
        Position limit, rotation limit in degrees, and share of frames within both.
    signed : tuple of (str, float or None)
        Axis and median of the signed error, estimated minus true.
    ratio : float or None
        Calibration of the stated covariances: median NEES relative to its expected median, 1 is ideal.
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
    """A trained network; values are None if unknown.

    Attributes
    ----------
    kind : str
        Kind of the network.
    checkpoint : str
        Fingerprint of the evaluated checkpoint.
    parameters, size_bytes : int or None
        Number of parameters and size of the checkpoint.
    images : int or None
        Number of images seen in the whole training.
    minutes : float or None
        Duration of the whole training.
    kept_minutes : float or None
        Training time after which this network was the best so far.
    ms_an_image : float or None
        Time per pose in milliseconds.
    """

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
    """A figure of an evaluation. width_px : width it was drawn for; svg : content of the file."""

    caption: str
    width_px: int
    svg: bytes


@dataclass(frozen=True, kw_only=True)
class RunFacts:
    """Results of `spn-model evaluate` in one folder of runs/.

    Attributes
    ----------
    name : str
        Name of the folder.
    units : str
        Unit of positions, "m" or "model".
    dataset : str
        Fingerprint of the dataset used for evaluation.
    is_current : bool
        Whether that is the area's current dataset.
    is_outdated : bool
        Whether one of the networks was trained further since the evaluation.
    networks : dict of str to NetworkFacts
        Networks by name.
    groups : dict of str to (str, dict of str to MethodErrors)
        Role and errors by method of each group, by its name.
    retrieval : dict of str to str
        Name of the better retrieval baseline by group.
    published : tuple of (str, str, float, float)
        Results of the paper: network, group, position, rotation in degrees.
    notes : tuple of str
        Notes of the evaluation.
    figures : tuple of Figure
        Figures to show.
    left_out : int
        Number of figures not shown.
    fixes : BundleFixes
        Without rows in an evaluation of several runs.
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
    fixes: BundleFixes = field(default_factory=BundleFixes)
