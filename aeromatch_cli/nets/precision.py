"""Where a network is evaluated, and in what numbers. torch is imported where it is asked: settings name these types."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import torch

Precision = Literal["auto", "float32", "bfloat16"]
Device = Literal["cpu", "auto"]


def device_of(asked: Device) -> str:
    """The device a setting means: "cuda" where `auto` finds one, else "cpu"."""
    import torch

    return "cuda" if asked == "auto" and torch.cuda.is_available() else "cpu"


def layer_type(precision: Precision, device: str = "cpu") -> torch.dtype:
    """float32 or bfloat16 for layers on "cpu" or "cuda"; auto is bfloat16 where `has_bfloat16`."""
    import torch

    half = precision == "bfloat16" or (precision == "auto" and has_bfloat16(device))
    return torch.bfloat16 if half else torch.float32


def has_bfloat16(device: str = "cpu") -> bool:
    """Whether this processor ("cpu" or "cuda") multiplies bfloat16 itself; emulated it is slower than float32."""
    import torch

    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())
