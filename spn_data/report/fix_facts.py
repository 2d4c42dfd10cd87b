"""Fixes of a bundle on evaluation flights, as the report shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class FixFigures:
    """Fixes of one flight in one way; numbers are None if unknown.

    Attributes
    ----------
    flight, method : str
        The method says whether an attitude was known, and whether that was simulated.
    images, usable, compared : int
        Number of images, of those with a usable fix, and of those with a label too.
    error_m, error_deg : float or None
        Medians.
    misleading : int
    misleading_at_most : float
        Upper bound of their share.
    nees, protected, longest_outage_s : float or None
    from_network : int or None
        Number of usable fixes that were searched for around the pose of the network, not by landmarks alone.
    """

    flight: str
    method: str
    images: int
    usable: int
    compared: int
    error_m: float | None
    error_deg: float | None
    misleading: int
    misleading_at_most: float
    nees: float | None
    protected: float | None
    longest_outage_s: float | None
    from_network: int | None = None


@dataclass(frozen=True)
class BundleFixes:
    """Fixes of the bundle of a run.

    Attributes
    ----------
    rows : tuple of FixFigures
    reason : str
        Why nothing was measured; empty otherwise.
    made_of : mapping of str to str
        SHA-256 of the `network` and the `landmarks` that they were measured with.
    attitudes : tuple of str
        Where the known attitude of each flight is from.
    """

    rows: tuple[FixFigures, ...] = ()
    reason: str = ""
    made_of: Mapping[str, str] = field(default_factory=dict)
    attitudes: tuple[str, ...] = ()
