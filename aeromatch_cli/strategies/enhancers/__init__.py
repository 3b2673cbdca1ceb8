"""Enhancers: strategy(pixels, valid) -> Enhanced, once per image, before any view is made.

pixels: (H, W) or (H, W, C) uint8 or uint16, RGB order; valid: (H, W) bool or None = all. The result has the same shape
and dtype.
"""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.enhancers.none import NoEnhancement
from aeromatch_cli.strategies.enhancers.shadow import ShadowEnhancement

ENHANCERS: Mapping[str, type[Strategy]] = {
    "none": NoEnhancement,
    "shadow": ShadowEnhancement,
}
