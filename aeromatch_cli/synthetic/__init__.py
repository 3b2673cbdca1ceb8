"""Rendered blocks with exact truth, for the demo, the tests and the benchmarks.

    solids -> scene -> raycast, noise -> texture -> render -> (flight) write -> truth

A scene is a list of textured triangles; a picture is rays through an exact camera; truth is the same rays asked again.
"""

from aeromatch_cli.synthetic.scene import PRESETS
from aeromatch_cli.synthetic.truth import Truth, load_truth, read_depth, transfer
from aeromatch_cli.synthetic.write import SynthSummary, render_block

__all__ = ["PRESETS", "SynthSummary", "Truth", "load_truth", "read_depth", "render_block", "transfer"]
