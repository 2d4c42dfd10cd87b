"""Fixes of a bundle on evaluation flights, as the report shows them."""

from __future__ import annotations

from dataclasses import dataclass


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


@dataclass(frozen=True)
class BundleFixes:
    """Fixes of the bundle of a run.

    Attributes
    ----------
    rows : tuple of FixFigures
    verdicts : tuple of (bool, str)
        Whether a sentence speaks for a flight, and the sentence.
    attitudes : tuple of str
        Where the known attitude of each flight is from.
    """

    rows: tuple[FixFigures, ...] = ()
    verdicts: tuple[tuple[bool, str], ...] = ()
    attitudes: tuple[str, ...] = ()
