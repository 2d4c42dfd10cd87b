"""Final bundle adjustments of a model, and the principal points that they estimate.

A principal point is held at the centre of the image, unless the measurements tell where it is: its standard
deviation, errors of the lens model included, must be far below what is usual among lenses, and the shift many
standard deviations long. A principal point that is held at a wrong place pulls those of the other cameras, so
that one such shift frees all that the measurements determine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.colmap.mapping import refine
from spn_data.colmap.model import MapObservations, Scene, read_map
from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import Hold
from spn_data.labels.map_points import MapPoints
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.correspondences import FramesToMap, held_cameras, lens_priors
from spn_data.reconstruction.notes import bend_note, principal_point_note
from spn_data.uncertainty.lens_errors import PRINCIPAL_POINT_SIGMA
from spn_data.uncertainty.map_covariance import MapCovariance, MapCovarianceOptions
from spn_data.uncertainty.shared_errors import LensPrior, PrincipalPoint
from spn_data.work.timing import Progress, Stopwatch

# Determined: the standard deviation is at most this share of what is usual among lenses.
_DETERMINED = 0.25
_SHIFTED_SIGMAS = 5.0
_LARGEST_SHIFT = (
    0.03  # of the image width; a larger one is a cropped image, or not a principal point
)


@dataclass(frozen=True, eq=False)
class RefinedModel:
    """A model after its final adjustments.

    Attributes
    ----------
    folder : Path
    scene : Scene
    observations : MapObservations
    points : MapPoints
    covariance : MapCovariance or None
        None if the measurements do not determine one.
    problem : str
        Why there is no covariance.
    notes : tuple of str
    """

    folder: Path
    scene: Scene
    observations: MapObservations
    points: MapPoints
    covariance: MapCovariance | None
    problem: str
    notes: tuple[str, ...]


def refine_model(
    model: Path,
    database: Path,
    frames: FramesToMap,
    work: Path,
    options: ReconstructOptions,
    progress: Progress,
    stopwatch: Stopwatch,
) -> RefinedModel:
    """Run the final adjustments of a model.

    Parameters
    ----------
    model : Path
        Folder of the model; it is only read.
    database : Path
        Database of its images.
    frames : FramesToMap
    work : Path
        Folder to write into.
    options : ReconstructOptions
    progress : Progress
    stopwatch : Stopwatch

    Returns
    -------
    RefinedModel
    """
    progress("refinement", 0, 1)
    held, lenses = held_cameras(database, frames), lens_priors(database, frames)
    notes = []
    with stopwatch.step("refinement"):
        done = _refine(
            model, work / "refined", frames, work, options, held, options.refine_principal_point
        )
    if done["bend_m"] > 0:
        notes.append(bend_note(done["bend_m"]))
    refined = _read(work / "refined", lenses, stopwatch)
    if refined.covariance is not None and not options.refine_principal_point:
        found = free_principal_points(
            refined.scene.cameras, refined.covariance.shared.principal_points, held
        )
        if found:
            others = {i: Hold.LENS for i in refined.scene.cameras if i not in found}
            with stopwatch.step("refinement"):
                _refine(
                    refined.folder,
                    work / "refined-principal-points",
                    frames,
                    work,
                    options,
                    held | others,
                    True,
                )
            refined = _read(work / "refined-principal-points", lenses, stopwatch)
            after = found
            if refined.covariance is not None:
                after = refined.covariance.shared.principal_points
            notes += [
                principal_point_note(key, refined.scene.cameras[i], after[i].sigma_px)
                for key, i in sorted(frames.camera_ids(refined.scene).items())
                if i in found
            ]
    progress("refinement", 1, 1)
    return replace(refined, notes=tuple(notes))


def _refine(
    source: Path,
    target: Path,
    frames: FramesToMap,
    work: Path,
    options: ReconstructOptions,
    held: Mapping[int, Hold],
    refine_principal_point: bool,
) -> dict[str, float]:
    known = np.flatnonzero(np.isfinite(frames.positions_m).all(axis=1))
    return refine(
        source,
        target,
        images=frames.folder,
        positions={frames.names[k]: frames.positions_m[k].tolist() for k in known},
        camera_model=options.camera_model,
        refine_principal_point=refine_principal_point,
        held=held,
        threads=options.threads,
        log=work / "mapping.log",
    )


def _read(folder: Path, lenses: Mapping[int, LensPrior], stopwatch: Stopwatch) -> RefinedModel:
    """Read a model and compute its covariance."""
    scene, observations, points = read_map(folder)
    covariance, problem = None, ""
    with stopwatch.step("covariance"):
        try:
            covariance = MapCovariance.of(scene, observations, MapCovarianceOptions(lenses=lenses))
        except GeometryError as error:
            problem = str(error)
    return RefinedModel(folder, scene, observations, points, covariance, problem, ())


def free_principal_points(
    cameras: Mapping[int, Camera], points: Mapping[int, PrincipalPoint], held: Mapping[int, Hold]
) -> dict[int, PrincipalPoint]:
    """Return the principal points to estimate, by camera id.

    These are all that the measurements determine if one of them is not where it is held, else none.
    """
    found, shifted = {}, False
    for camera_id, point in points.items():
        width = cameras[camera_id].width
        plausible = np.linalg.norm(point.shift_px) <= _LARGEST_SHIFT * width
        known = np.all(point.sigma_px <= _DETERMINED * PRINCIPAL_POINT_SIGMA * width)
        if camera_id not in held and plausible and known:
            found[camera_id] = point
            distance = point.shift_px @ np.linalg.solve(point.covariance, point.shift_px)
            shifted = shifted or bool(distance >= _SHIFTED_SIGMAS**2)
    return found if shifted else {}
