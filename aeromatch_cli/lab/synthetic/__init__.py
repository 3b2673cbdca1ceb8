"""Rendered blocks with exact truth, for the demo, the tests, the benchmarks and training.

    noise, paint -> solids, materials, terrain -> scenes -> scene -> raycast -> light, shade -> render -> sensor
    flights, presets -> block -> write -> truth

A scene is a list of textured triangles; a picture is rays through an exact camera; truth is the same rays asked again.
"""

from aeromatch_cli.lab.synthetic.block import SynthSummary, render_block
from aeromatch_cli.lab.synthetic.presets import PRESETS
from aeromatch_cli.lab.synthetic.truth import Truth, load_truth, transfer

__all__ = ["PRESETS", "SynthSummary", "Truth", "load_truth", "render_block", "transfer"]
