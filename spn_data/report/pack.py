"""Arrays and texts embedded in a page: little-endian binary in base64, and script-safe JSON."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np

_KINDS = {"f4": "<f4", "i2": "<i2", "i4": "<i4", "u1": "|u1"}


def pack(values: np.ndarray, kind: str) -> dict[str, str]:
    """Pack a flattened array as {"kind", "base64"}; kind: f4, i2, i4 or u1. NaN stays NaN in f4."""
    flat = np.ascontiguousarray(values).astype(_KINDS[kind]).ravel()
    return {"kind": kind, "base64": base64.b64encode(flat.tobytes()).decode("ascii")}


def pack_texts(values: np.ndarray) -> dict[str, Any]:
    """Pack repetitive texts (N,) as the distinct ones and the index of each text."""
    distinct, which = np.unique(values, return_inverse=True)
    return {"texts": distinct.tolist(), "which": pack(which, "i4")}


def script_json(value: Any) -> str:
    """Return JSON for a <script> element: ASCII, with `<`, `>` and `&` escaped so that no tag can occur."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
