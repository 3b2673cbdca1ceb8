"""Arms of comparisons: strategies that presets are measured against, and that no preset uses.

They are called as those of their families (`aeromatch_cli.strategies`). Settings can name them once `add_arms` was
called, in that process alone: `aeromatch` never does.
"""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.config.schema import add_strategies
from aeromatch_cli.lab.strategies.clahe import ClaheEnhancement
from aeromatch_cli.lab.strategies.homography import Homography
from aeromatch_cli.lab.strategies.magsac import Magsac
from aeromatch_cli.lab.strategies.tilts import Tilts
from aeromatch_cli.lab.strategies.wallis import WallisEnhancement
from aeromatch_cli.strategies import Strategy

# Family -> name -> class.
ARMS: Mapping[str, Mapping[str, type[Strategy]]] = {
    "enhance": {"clahe": ClaheEnhancement, "wallis": WallisEnhancement},
    "simulate": {"tilts": Tilts},
    "filter": {"homography": Homography, "magsac": Magsac},
}


def add_arms() -> None:
    """Settings of this process may name the arms, too."""
    add_strategies(ARMS)
