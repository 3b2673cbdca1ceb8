"""What files of control points hold, whatever program wrote them: coordinates of points, and where images show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from aeromatch_cli.blocks.accuracies import Sigmas
from aeromatch_cli.blocks.pose_files.source import Source, image_name, number
from aeromatch_cli.errors import ConfigError

# Points that take no part in the fit, as programs and people call them.
_CHECK = frozenset({"check", "checkpoint", "check_point", "checked"})


@dataclass(frozen=True)
class SurveyedPoint:
    """position: x, y, z in the CRS of the file, or longitude, latitude and height. where: file and line, for messages.
    sigmas_m: standard deviations of x, y, z, None where the file states none."""

    name: str
    where: str
    position: tuple[float, float, float]
    sigmas_m: Sigmas | None = None
    check: bool = False


@dataclass(frozen=True)
class Mark:
    """Where an image shows a point. pixel: x, y from the upper left corner of the image, whose first pixel has its
    centre at (0.5, 0.5). sigma_px: standard deviation, None where the file states none."""

    point: str
    image: str
    line: int
    pixel: tuple[float, float]
    sigma_px: float | None = None


@dataclass(frozen=True)
class Survey:
    """What one file, or several together, hold.

    crs: of the coordinates, as the file states it, None where it does not; crs_where: the place where it stands, or
    belongs. geographic: whether they are degrees, where no CRS is stated. measured_in: the file that has the marks.
    heights: what they count from, as of `crs.heights_of`, where comments or columns state it.
    """

    points: tuple[SurveyedPoint, ...] = ()
    marks: tuple[Mark, ...] = ()
    crs: str | None = None
    crs_where: str = ""
    geographic: bool = False
    remarks: tuple[str, ...] = ()
    measured_in: Path = Path()
    heights: str = ""


def is_check(word: str) -> bool:
    """Whether a word says that a point is a check point."""
    return word.strip().lower().replace(" ", "_").replace("-", "_") in _CHECK


def mark(
    source: Source, line: int, cells: Sequence[str], sigma_px: float | None = None, *, comma: bool = False
) -> Mark:
    """Of point, image, x and y as they stand in a line. comma: numbers may have a decimal comma. ConfigError as
    `number`, and where a name is missing."""
    point, image = cells[0].strip(), image_name(cells[1])
    for what, name in (("point", point), ("image", image)):
        if not name:
            raise ConfigError(f"{source.at(line)}: the name of the {what} is missing")
    x, y = (
        number(source.at(line, what), cell, decimal_comma=comma)
        for what, cell in zip(("pixel x", "pixel y"), cells[2:4], strict=True)
    )
    return Mark(point, image, line, (x, y), sigma_px)
