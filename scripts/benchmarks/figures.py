"""The README's four results: figures that are read from the tables of docs/results, never typed.

    <!-- results: start -->
    | question | result | command |
    ...
    <!-- results: end -->

`scripts/bench results --docs` writes what stands between; tests/test_readme.py compares it with the tables.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from aeromatch_cli.files import write_text
from benchmarks.pages import table_text
from benchmarks.stamps import REPOSITORY
from benchmarks.tables import markdown

README = REPOSITORY / "README.md"
_RESULTS = re.compile(r"(<!-- results: start -->\n).*?(<!-- results: end -->)", re.DOTALL)
NOT_MADE = "the table has not been made yet"


@dataclass(frozen=True)
class Figure:
    """The cell of a table in `column`, of the line whose cells are those of `where`."""

    table: str
    column: str
    where: Mapping[str, str]


@dataclass(frozen=True)
class Result:
    """A line of the README. text: with {NAME} for each of the figures."""

    question: str
    text: str
    figures: Mapping[str, Figure]
    command: str


def _auto(column: str, method: str) -> Figure:
    return Figure("bench_auto", column, {"condition": "all", "method": f"`{method}`"})


def _pairs(section: str, column: str, method: str) -> Figure:
    return Figure(f"bench_peers_{section}", column, {"view angle": "all", "method": f"`{method}`"})


_OURS = {"flight": "all", "method": "`aeromatch`"}
RESULTS: Sequence[Result] = (
    Result(
        "Rendered blocks of two seeds, poses off by 3 degrees and 5 % of the flying height: one sun, two suns, two "
        "exposures, five cameras, poor texture, rows and facades",
        "`auto` has {baseline} x the correct matches of `baseline`, {pycolmap} x those of pycolmap (guided); {share} "
        "of what it keeps is correct, of pycolmap's {theirs}; worst block {worst}",
        {
            "baseline": _auto("auto / it", "baseline"),
            "pycolmap": _auto("auto / it", "pycolmap-guided"),
            "share": _auto("correctness", "auto"),
            "theirs": _auto("correctness", "pycolmap-guided"),
            "worst": _auto("worst block", "auto"),
        },
        "scripts/bench auto rendered",
    ),
    Result(
        "Pairs of all view angles with exact poses, 2048 descriptors an image, beside the published chain that finds "
        "most on this project's ground views: rendered under two suns, and of two real blocks that no network was "
        "trained on",
        "rendered: `oblique` has {disk} x the correct matches of DISK with LightGlue, {right} right, its {theirs}; "
        "real: {aliked} x those of ALIKED with LightGlue, {real} on their epipolar lines, its {its}",
        {
            "disk": _pairs("rendered", "`oblique` / it", "disk+lightglue@ground"),
            "right": _pairs("rendered", "right", "oblique"),
            "theirs": _pairs("rendered", "right", "disk+lightglue@ground"),
            "aliked": _pairs("real", "`oblique` / it", "aliked+lightglue@ground"),
            "real": _pairs("real", "right", "oblique"),
            "its": _pairs("real", "right", "aliked+lightglue@ground"),
        },
        "scripts/bench peers",
    ),
    Result(
        "Simulated blocks of 24 images, lenses like real ones of which EXIF tells the focal length alone",
        "check points {horizontal} px off horizontally and {height} px in height; true over stated errors {stated}",
        {
            "horizontal": Figure("bench_calibration", "horizontal, px", _OURS),
            "height": Figure("bench_calibration", "height, px", _OURS),
            "stated": Figure("bench_calibration", "error / stated", _OURS),
        },
        "scripts/bench calibration",
    ),
    Result(
        "Growth from 300 to 1,000 small images, two cores",
        "{seconds} s, {memory} MB; seconds grow with the power {power} of the number of images",
        {
            "seconds": Figure("bench_growth", "1000 images", {"": "whole run, s"}),
            "memory": Figure("bench_growth", "1000 images", {"": "peak memory, MB"}),
            "power": Figure("bench_growth", "exponent to 1000", {"": "whole run, s"}),
        },
        "scripts/bench growth",
    ),
)


def read(figure: Figure, text: str | None = None) -> str:
    """The figure as its table states it, "" where the table has not been made. text: the table's, else its page's.

    Raises ValueError where a table that was made has not exactly one such line, or no such column.
    """
    lines = [line for line in (table_text(figure.table) if text is None else text).splitlines() if line[:1] == "|"]
    if not lines:
        return ""
    head, _, *rest = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    rows = [dict(zip(head, cells, strict=False)) for cells in rest]
    found = [row for row in rows if all(row.get(key) == value for key, value in figure.where.items())]
    if len(found) != 1 or figure.column not in found[0]:
        raise ValueError(f"{figure.table} has {len(found)} lines of {dict(figure.where)}, columns {', '.join(head)}")
    return found[0][figure.column]


def readme_table() -> str:
    """The table of the README."""
    lines = []
    for result in RESULTS:
        found = {name: read(figure) for name, figure in result.figures.items()}
        stated = result.text.format(**found) if all(found.values()) else NOT_MADE
        lines.append((result.question, stated, f"`{result.command}`"))
    return markdown(("question", "result", "command"), lines)


def with_results(text: str) -> str:
    """The README's text with the present figures."""
    table = readme_table()
    return _RESULTS.sub(lambda match: f"{match[1]}{table}\n{match[2]}", text)


def write_readme() -> None:
    """Bring the README's figures up to date."""
    write_text(README, with_results(README.read_text(encoding="utf-8")))
