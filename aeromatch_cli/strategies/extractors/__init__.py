"""Extractors: strategy(camera, views) -> Features, once per image."""

from __future__ import annotations

from aeromatch_cli.strategies.extractors.sift import Sift

EXTRACTORS = {"sift": Sift}
