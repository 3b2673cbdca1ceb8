"""What numbers a network is best evaluated in."""

from __future__ import annotations

import torch


def has_bfloat16(device: str = "cpu") -> bool:
    """Whether this processor ("cpu" or "cuda") multiplies bfloat16 itself; emulated it is slower than float32."""
    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())
