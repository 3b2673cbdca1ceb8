"""HEIC and HEIF pictures, by pillow-heif where it is installed: as the file shows them, in 8 bits."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec

SUFFIXES = (".heic", ".heif", ".hif")


@cache
def readable() -> bool:
    """Whether pillow-heif is there; if so, Pillow opens these files from now on."""
    if find_spec("pillow_heif") is None:
        return False
    import_module("pillow_heif").register_heif_opener()
    return True
