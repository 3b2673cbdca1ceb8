"""Device and number type of a network. torch is imported inside the functions: settings name these types."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from aeromatch_cli.errors import ConfigError

if TYPE_CHECKING:
    import torch

Precision = Literal["auto", "float32", "bfloat16"]
Device = Literal["cpu", "cuda", "auto"]
# A strategy's setting. Where a network runs is no part of a recipe, as the processor is none: answers differ by the
# rounding of the precision, which is a setting of its own for who wants the same one everywhere.
DEVICE: Any = Field(
    "auto",
    description="Where the network runs; auto: on CUDA where there is one. Results of the two are equal to a "
    "tolerance; cpu: the same bits everywhere.",
    json_schema_extra={"fingerprint": "left out"},
)
# What a driver of NVIDIA makes below /dev: on a machine, on Jetson, and in WSL.
_DRIVERS = ("nvidia*", "nvhost*", "nvmap", "dxg")


def device_of(setting: Device) -> str:
    """The device a setting means: "cuda" where `auto` finds one, else "cpu". Raises ConfigError where there is none."""
    if setting == "cpu" or (setting == "auto" and not _may_have_cuda()):
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if setting == "cuda":
        raise ConfigError("device `cuda`: torch sees none on this machine; set `auto`, which takes one where there is")
    return "cpu"


def check_device(setting: Device) -> None:
    """Raise ConfigError where the device that a setting names is not there. `auto` fits any machine: torch, which takes
    seconds to load, is not asked."""
    if setting == "cuda":
        device_of(setting)


def _may_have_cuda() -> bool:
    """Whether torch may find a device, without loading it; only Linux tells."""
    return sys.platform != "linux" or any(next(Path("/dev").glob(name), None) for name in _DRIVERS)


def layer_type(precision: Precision, device: str = "cpu") -> torch.dtype:
    """float32 or bfloat16 for layers on "cpu" or "cuda"; auto is bfloat16 where `has_bfloat16`."""
    import torch

    half = precision == "bfloat16" or (precision == "auto" and has_bfloat16(device))
    return torch.bfloat16 if half else torch.float32


def has_bfloat16(device: str = "cpu") -> bool:
    """Whether this processor ("cpu" or "cuda") multiplies bfloat16 itself; emulated it is slower than float32.

    A processor that torch is held to use as an older one (ATEN_CPU_CAPABILITY=avx2) does not.
    """
    import torch

    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    if torch.backends.cpu.get_cpu_capability() in ("DEFAULT", "AVX2"):
        return False
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())
