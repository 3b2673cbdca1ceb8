"""Which truth a folder holds."""

from __future__ import annotations

from pathlib import Path

from aeromatch_cli.evaluate.opening import BlockTruth, existing, open_reference
from aeromatch_cli.lab.rendered import RenderedTruth
from aeromatch_cli.lab.synthetic.raycast import check_installed
from aeromatch_cli.lab.synthetic.truth import load_truth


def open_truth(folder: Path) -> BlockTruth:
    """The truth in a folder: a rendered block (truth.json), or reference poses.

    Raises ConfigError where it holds neither, or a rendered block needs a library that is not installed; InputError
    where it holds something damaged.
    """
    if (folder / "truth.json").is_file():
        check_installed()
        return RenderedTruth(load_truth(folder), existing(folder / "images"))
    return open_reference(folder)
