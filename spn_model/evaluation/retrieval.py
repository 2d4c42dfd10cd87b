"""Image retrieval on a data set: the most similar training image of each frame, cached in a file."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.geometry.json_values import parse_json
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import write_json
from spn_data.storage.stage_record import versions
from spn_data.work.timing import Progress
from spn_model.evaluation.baselines import GEM, VLAD, Describe, Images, gem, most_similar, vlad
from spn_model.evaluation.feature_maps import squeezenet_maps

_logger = logging.getLogger(__name__)

VERSION = 1  # of the cache; increase it if image descriptors change
_METHODS = (VLAD, GEM)
_MAX_BYTES = 100_000_000


def most_similar_images(
    dataset: Dataset,
    training: DatasetGroup,
    groups: Sequence[DatasetGroup],
    progress: Progress,
    kept: Path | None = None,
) -> dict[str, list[np.ndarray]]:
    """Return, by method and for each group, the row (N,) of the most similar training image.

    The row is -1 if there is none. kept : cache file. Rows are read from it if it belongs to this very data
    set, otherwise they are computed and written to it. It holds rows only, never poses, so that poses of new
    labels are never mixed with old ones.
    """
    key = _key(dataset, training, groups)
    if kept is not None:
        found = _read(kept, key, training, groups)
        if found is not None:
            return found
    total = len(training) + sum(len(group) for group in groups)
    rows: dict[str, list[np.ndarray]] = {}
    for method in _METHODS:
        counted = [_ProgressImages(g, progress, f"{method}", total) for g in (training, *groups)]
        done = 0
        for images in counted:
            images.before = done
            done += len(images)
        describe: Describe = vlad(training) if method == VLAD else gem(squeezenet_maps())
        known = describe(counted[0])
        rows[method] = [most_similar(known, describe(images)) for images in counted[1:]]
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        plain = {method: [one.tolist() for one in of] for method, of in rows.items()}
        write_json(kept, {"version": VERSION, "key": key, "rows": plain})
    return rows


class _ProgressImages:
    """Images that report progress as they are read, row by row in order."""

    def __init__(self, images: Images, progress: Progress, step: str, total: int):
        self._images, self._progress, self._step, self._total = images, progress, step, total
        self.before = 0

    def __len__(self) -> int:
        return len(self._images)

    def image(self, row: int) -> np.ndarray:
        self._progress(self._step, self.before + row + 1, self._total)
        return self._images.image(row)

    def valid(self, row: int) -> np.ndarray | None:
        return self._images.valid(row)


def _key(dataset: Dataset, training: DatasetGroup, groups: Sequence[DatasetGroup]) -> str:
    """Return a hash of everything that decides which images are compared, and how."""
    digest = hashlib.sha256()
    stated = {
        "version": VERSION,
        "versions": versions(),
        "file": content_fingerprint(dataset.path),
        "made_from": dict(dataset.info.fingerprints),
        "groups": [[group.name, group.image_size] for group in (training, *groups)],
    }
    digest.update(json.dumps(stated, sort_keys=True).encode())
    for group in (training, *groups):
        digest.update("\n".join(group.names.tolist()).encode("utf-8", "backslashreplace"))
    return digest.hexdigest()


def _read(
    path: Path, key: str, training: DatasetGroup, groups: Sequence[DatasetGroup]
) -> dict[str, list[np.ndarray]] | None:
    """Return the cached rows, or None if the cache belongs to other data or is damaged."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            return None
        table = parse_json(path.read_text(encoding="utf-8"))
        if table["key"] != key:
            return None
        found = {
            method: [np.array(rows, dtype=np.int64) for rows in table["rows"][method]]
            for method in _METHODS
        }
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        _logger.debug("%s: cannot be used (%r), compared again", path, error)
        return None
    for of in found.values():
        if [rows.shape for rows in of] != [(len(group),) for group in groups]:
            return None
        if any(len(rows) and not -1 <= rows.min() <= rows.max() < len(training) for rows in of):
            return None
    return found
