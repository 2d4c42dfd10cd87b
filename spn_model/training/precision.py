"""Choice of precision: bfloat16 on processors where it is faster than float32."""

from __future__ import annotations

from functools import cache

import torch


@cache
def bfloat16_is_fast(device_type: str) -> bool:
    """Return whether a device ("cpu" or "cuda") has native bfloat16; others emulate it slowly."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device_type == "cpu":
        capabilities = torch.backends.cpu.get_cpu_capability()
        return capabilities.startswith("AVX512") and _cpu_has_bfloat16()
    return False


def _cpu_has_bfloat16() -> bool:
    # torch has no public name for this yet.
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())
