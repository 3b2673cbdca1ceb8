"""Pairs from a list. The only pairing that reads a file: which pairs to match is the user's own input here."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from aeromatch_cli.data import Block, Pair
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.measure import measured_pairs, ordered


class PairFile(Strategy):
    """Pairs of a text file: two image names on each line, relative to the images folder.

    Names are separated by a comma, semicolon or tab, or by blanks where no name holds one; further columns are
    ignored, as are empty lines, lines that begin with # and a first line of column names. COLMAP's match lists read.
    """

    name: Literal["file"] = "file"
    path: str = Field(
        default="", description="Text file with two image names on each line.", json_schema_extra={"path": True}
    )

    def fingerprint_files(self) -> tuple[str, ...]:
        """The list itself: another content is another recipe."""
        return (self.path,) if self.path else ()

    def __call__(self, block: Block) -> list[Pair]:
        """Pairs of a block; see the family's table for the contract.

        Raises ConfigError where the file cannot be read, names an unknown image or holds no pair.
        """
        keys = self._parse(self._lines(), {image.name: image.image_id for image in block.images})
        if not keys:
            raise ConfigError(f"the pair list {self.path} holds no pair; write two image names on each line")
        return measured_pairs(block, dict.fromkeys(keys, self.name), block_footprints(block))

    def check_files(self, descriptor_length: int) -> None:
        self._lines()

    def _lines(self) -> list[str]:
        if not self.path:
            raise ConfigError(
                "pairs by file need the list's path: set pairs.path to a file with two names on each line"
            )
        try:
            return given_bytes(Path(self.path)).decode("utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"cannot read the pair list {self.path}: {error}; set pairs.path to a text file"
            ) from error

    def _parse(self, lines: list[str], id_of: dict[str, str]) -> set[tuple[str, str]]:
        keys = set()
        first = True
        for number, line in enumerate(lines, start=1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            names = _two_names(line, id_of)
            is_header, first = first and _is_header(names), False
            if is_header:
                continue
            where = f"{self.path}, line {number}"
            if len(names) < 2:
                raise ConfigError(f"{where}: expected two image names, found {line.strip()!r}")
            for name in names[:2]:
                if name not in id_of:
                    raise ConfigError(f"{where}: no image is named {name!r}; names are relative to the images folder")
            if names[0] == names[1]:
                raise ConfigError(f"{where}: {names[0]!r} is paired with itself; remove the line")
            keys.add(ordered(id_of[names[0]], id_of[names[1]]))
        return keys


def _two_names(line: str, id_of: dict[str, str]) -> list[str]:
    """Names of one line under the first separator that the line holds."""
    for separator in (",", ";", "\t"):
        if separator in line:
            return [part.strip().strip('"').replace("\\", "/") for part in line.split(separator)]
    words = [word.replace("\\", "/") for word in line.split()]
    # Blanks inside names: accepted where exactly one way of cutting the line gives two known names.
    cuts = [(" ".join(words[:cut]), " ".join(words[cut:])) for cut in range(1, len(words))]
    known = [list(cut) for cut in cuts if cut[0] in id_of and cut[1] in id_of]
    return known[0] if len(known) == 1 else words


def _is_header(names: list[str]) -> bool:
    """Whether a line holds column names: no word looks like a file with an extension."""
    return len(names) >= 2 and not any(Path(name).suffix for name in names[:2])
