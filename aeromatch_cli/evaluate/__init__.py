"""Matches against truth: the metrics, and who knows the truth of a block.

    metrics, scores, texture -> overlap -> reference -> opening -> work -> totals, mapping -> output, plots

Reference poses are judged by here; exact truth of rendered blocks is opened by `lab.open_truth`.

Errors are in px of the stored images, also where matching reduced them (--max-size); a pair is judged from both sides.
Masked ground counts as overlap like any other.
"""

from aeromatch_cli.evaluate.opening import BlockTruth, open_reference
from aeromatch_cli.evaluate.reference import ReferenceTruth
from aeromatch_cli.evaluate.scores import Conditions, PairScore
from aeromatch_cli.evaluate.work import Evaluation, evaluate_workspace

__all__ = [
    "BlockTruth",
    "Conditions",
    "Evaluation",
    "PairScore",
    "ReferenceTruth",
    "evaluate_workspace",
    "open_reference",
]
