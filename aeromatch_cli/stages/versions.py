"""Versions that enter fingerprints beside those of the strategies."""

from __future__ import annotations

from functools import cache
from importlib import metadata

# Part of every fingerprint that pixels enter; raised when decoding, masking, warping or merging change results.
PIPELINE_VERSION = 3


@cache
def library_version(distribution: str) -> str:
    """Return the version of an installed library whose arithmetic decides results; another one makes them stale."""
    return metadata.version(distribution)
