"""Data sets of pairs as they are handed out: where their pictures are, and what is known to be true of each pair.

homogr   NAMEA.jpg, NAMEB.jpg, NAME.csv: hand-measured points x0, y0, x1, y1 of one plane, the first pixel's centre at
         (1, 1) (Lebeda, Matas, Chum, Fixing the Locally Optimized RANSAC, BMVC 2012; given with danini/magsac).
hpatches SEQUENCE/1.ppm to 6.ppm, SEQUENCE/H_1_2 to H_1_6: homographies (Balntas et al., HPatches, CVPR 2017).
evd      1/NAME.png, 2/NAME.png, h/NAME.txt: homographies (Mishkin, Matas, Perdoch, MODS, CVIU 2015).
wxbs     SET/PAIR/01.png, 02.png (or .jpg), corrs.txt: hand-measured points x0 y0 x1 y1, not of one plane (Mishkin et
         al., WxBS, BMVC 2015, version 1.1).

Homographies and points of the last three have the centre of the first pixel at (0, 0), as everything here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import InputError
from aeromatch_cli.geometry.frames import apply_homography

# Points of a grid that a homography moves: they stand for hand-measured ones.
_GRID = 5


@dataclass(frozen=True, eq=False)
class Anchor:
    """A pair of pictures. points0_px, points1_px: (N, 2) places of the same things, None where `homography` (3, 3) from
    picture 0 to 1 is known instead. planar: whether a homography explains the whole pair."""

    name: str
    image0: Path
    image1: Path
    points0_px: FloatArray | None = None
    points1_px: FloatArray | None = None
    homography: FloatArray | None = None
    planar: bool = True

    def truth(self, size0: tuple[int, int], size1: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Places (N, 2) in both pictures, whose width and height are given."""
        if self.points0_px is not None and self.points1_px is not None:
            return self.points0_px, self.points1_px
        assert self.homography is not None
        axes = (np.linspace(0.0, side - 1.0, _GRID) for side in size0)
        grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        there = apply_homography(self.homography, grid)
        inside = ((there >= 0.0) & (there <= np.array(size1) - 1.0)).all(axis=1)
        return grid[inside], there[inside]


def _homogr(folder: Path) -> Iterator[Anchor]:
    for table in sorted(folder.glob("*.csv")):
        rows = _numbers(table, ",", heads=1) - 1.0
        sides = (table.with_name(f"{table.stem}{side}.jpg") for side in "AB")
        yield Anchor(table.stem, *sides, rows[:, :2], rows[:, 2:4])


def _hpatches(folder: Path) -> Iterator[Anchor]:
    for path in sorted(folder.glob("*/H_1_*")):
        first, other = (path.with_name(f"{n}.ppm") for n in ("1", path.name.rpartition("_")[2]))
        yield Anchor(f"{path.parent.name}-{other.stem}", first, other, homography=_numbers(path))


def _evd(folder: Path) -> Iterator[Anchor]:
    for path in sorted(folder.glob("h/*.txt")):
        sides = (folder / side / f"{path.stem}.png" for side in "12")
        yield Anchor(path.stem, *sides, homography=_numbers(path))


def _wxbs(folder: Path) -> Iterator[Anchor]:
    for path in sorted(folder.glob("*/*/corrs.txt")):
        rows = _numbers(path)
        kinds = [".png" if path.with_name(f"{n}.png").is_file() else ".jpg" for n in ("01", "02")]
        sides = (path.with_name(f"{n}{kind}") for n, kind in zip(("01", "02"), kinds, strict=True))
        yield Anchor(f"{path.parts[-3]}-{path.parts[-2]}", *sides, rows[:, :2], rows[:, 2:4], planar=False)


def _numbers(path: Path, delimiter: str | None = None, heads: int = 0) -> FloatArray:
    try:
        return np.loadtxt(path, np.float64, delimiter=delimiter, skiprows=heads, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path} is no table of numbers: {error}") from error


LAYOUTS: Mapping[str, Callable[[Path], Iterator[Anchor]]] = {
    "homogr": _homogr, "hpatches": _hpatches, "evd": _evd, "wxbs": _wxbs,
}  # fmt: skip


def anchors_in(layout: str, folder: Path) -> list[Anchor]:
    """All pairs of a data set. Raises InputError where the folder holds none, or lacks a picture of one."""
    found = list(LAYOUTS[layout](folder)) if folder.is_dir() else []
    if not found:
        raise InputError(f"{folder} holds no pair in the layout {layout}: `scripts/bench anchors --help` shows layouts")
    for path in (path for anchor in found for path in (anchor.image0, anchor.image1)):
        if not path.is_file():
            raise InputError(f"{path} is missing, which a pair of the layout {layout} needs: unpack the data set again")
    return found
