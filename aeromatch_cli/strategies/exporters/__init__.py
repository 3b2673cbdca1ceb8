"""Exporters: from verified matches to the files of another program.

Call: strategy(contents: ExportContents, folder: Path) -> ExportSummary. The folder is replaced as a whole; nothing
else is touched. Pixel frames and identifiers are translated here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.alicevision import AliceVision
from aeromatch_cli.strategies.exporters.bingo import Bingo
from aeromatch_cli.strategies.exporters.blocks_exchange import BlocksExchange
from aeromatch_cli.strategies.exporters.bundler import Bundler
from aeromatch_cli.strategies.exporters.colmap import Colmap
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, PairContents
from aeromatch_cli.strategies.exporters.geojson import GeoJson
from aeromatch_cli.strategies.exporters.geopackage import GeoPackage
from aeromatch_cli.strategies.exporters.hloc import Hloc
from aeromatch_cli.strategies.exporters.micmac import MicMac
from aeromatch_cli.strategies.exporters.openmvg import OpenMvg
from aeromatch_cli.strategies.exporters.opensfm import OpenSfm
from aeromatch_cli.strategies.exporters.ply import Ply
from aeromatch_cli.strategies.exporters.tracks import Tracks

EXPORTERS: Mapping[str, type[Strategy]] = {
    "colmap": Colmap,
    "opensfm": OpenSfm,
    "micmac": MicMac,
    "openmvg": OpenMvg,
    "bundler": Bundler,
    "bingo": Bingo,
    "blocks-exchange": BlocksExchange,
    "alicevision": AliceVision,
    "hloc": Hloc,
    "geojson": GeoJson,
    "geopackage": GeoPackage,
    "ply": Ply,
    "tracks": Tracks,
}

__all__ = ["EXPORTERS", "Colmap", "ExportContents", "ExportSummary", "PairContents"]
