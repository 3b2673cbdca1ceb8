"""What the exporters of maps draw of a block: where images were taken, and how they hang together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from aeromatch_cli.data import FloatArray
from aeromatch_cli.strategies.exporters.contents import ExportContents
from aeromatch_cli.strategies.exporters.solution import Matched, Solution, unplaced

# Images with fewer verified matches hang loosely on the block.
WEAK_MATCHES = 50


@dataclass(frozen=True, eq=False)
class Links:
    """positions: image_id -> centre in the world. ties: image_id -> verified matches. lines: pairs of placed images,
    with their matches."""

    positions: Mapping[str, FloatArray]
    ties: Counter[str]
    lines: Sequence[tuple[tuple[str, str], int]]

    @classmethod
    def of(cls, contents: ExportContents, solution: Solution, found: Matched) -> Links:
        positions = {i: pose.center_m for i, pose in contents.block.poses.items()}
        positions |= {i: center_m for i, (_, center_m) in solution.poses.items()}
        positions = {i: center_m for i, center_m in positions.items() if i not in unplaced(contents)}
        ties: Counter[str] = Counter()
        for id0, id1, rows in found.pairs:
            ties.update({id0: len(rows), id1: len(rows)})
        placed = [((a, b), len(rows)) for a, b, rows in found.pairs if a in positions and b in positions]
        return cls(positions, ties, placed)
