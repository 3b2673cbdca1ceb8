"""Device and number type of a network. torch is imported inside the functions: settings name these types."""

from __future__ import annotations

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
    "cpu", description="`auto` takes CUDA where there is one.", json_schema_extra={"fingerprint": "left out"}
)


def device_of(setting: Device) -> str:
    """The device a setting means: "cuda" where `auto` finds one, else "cpu". Raises ConfigError where there is none."""
    if setting == "cpu":
        return setting
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if setting == "cuda":
        raise ConfigError("device `cuda`: torch sees none on this machine; set `auto`, which takes one where there is")
    return "cpu"


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
