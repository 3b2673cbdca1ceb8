"""Exporters: from verified matches to the files of another program.

Call: strategy(contents: ExportContents, folder: Path) -> ExportSummary. The folder is replaced as a whole; nothing
else is touched. Pixel frames and identifiers are translated here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.colmap import Colmap
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, PairContents

EXPORTERS: Mapping[str, type[Strategy]] = {"colmap": Colmap}

__all__ = ["EXPORTERS", "Colmap", "ExportContents", "ExportSummary", "PairContents"]
