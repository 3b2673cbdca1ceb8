"""A file or folder of poses as it lies on the disk, and what all readers need: text, numbers with their place, rows."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.blocks.gis_columns import with_coordinates
from aeromatch_cli.blocks.lenses import remark
from aeromatch_cli.blocks.pose_columns import PositionKind
from aeromatch_cli.blocks.poses import PoseRow
from aeromatch_cli.blocks.statements import Quantity, Statements, statements_of
from aeromatch_cli.blocks.units import Kind, factor, refuse_rounded
from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes, text_encoding
from aeromatch_cli.geometry.lenses import Nearest
from aeromatch_cli.geometry.rotations import to_quaternion

_CRS_TEXT = re.compile(
    r"(PROJ|GEOG|COMPD|GEOD|BOUND|COMPOUND|LOCAL_|ENG|ENGINEERING)(CS|CRS)\[|\+proj=|EPSG:", re.IGNORECASE
)
# A file that is longer is no list of poses; a reconstruction with its points may be large.
_LARGEST_BYTES = 2_000_000_000


@dataclass(frozen=True)
class Source:
    """What --poses names. Its content is read when a reader asks for it."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name.lower()

    @cached_property
    def is_folder(self) -> bool:
        return self.path.is_dir()

    @cached_property
    def raw(self) -> bytes:
        """Empty for a folder. Raises ConfigError where the file cannot be read."""
        if self.is_folder:
            return b""
        try:
            if self.path.stat().st_size > _LARGEST_BYTES:
                raise ConfigError(f"pose file {self.path} is larger than {_LARGEST_BYTES // 10**9} GB")
            return given_bytes(self.path)
        except OSError as error:
            raise ConfigError(
                f"pose list {self.path} cannot be read ({error.strerror}): give a pose file, or exif, with --poses"
            ) from error

    @cached_property
    def text(self) -> str:
        """Empty where the file is no text (UTF-8, UTF-16 with its mark, else Latin-1)."""
        encoding = text_encoding(self.raw)
        if b"\0" in self.raw[:4096] and encoding != "utf-16":
            return ""
        try:
            return self.raw.decode(encoding)
        except UnicodeDecodeError:
            return self.raw.decode("latin-1")

    @cached_property
    def lines(self) -> list[str]:
        """Columns of points are columns of coordinates here."""
        return with_coordinates(self.text.splitlines())

    @cached_property
    def tree(self) -> Any:
        """JSON content, None where it is none."""
        import json

        if self.text.lstrip()[:1] not in ("{", "["):
            return None
        try:
            return json.loads(self.text)
        except (ValueError, RecursionError):
            return None

    @cached_property
    def xml(self) -> Any:
        """Root element, None where the file is no XML. Entities are refused."""
        from xml.etree.ElementTree import ParseError

        from defusedxml import DefusedXmlException
        from defusedxml.ElementTree import fromstring

        if self.text.lstrip()[:1] != "<":
            return None
        try:
            return fromstring(self.text.encode("utf-8") if "encoding" not in self.text[:100] else self.raw)
        except (ParseError, DefusedXmlException, ValueError, LookupError):
            return None

    def xml_root(self) -> Any:
        """The same. Raises ConfigError where the file is no XML."""
        if self.xml is None:
            raise ConfigError(
                f"{self.path} is no XML that can be read: it is cut off, or declares entities (DOCTYPE), which are "
                "refused"
            )
        return self.xml

    def records(self, comment: str = "#") -> Iterator[tuple[int, str]]:
        """Lines with their numbers, without empty ones and comments."""
        for number, line in enumerate(self.lines, start=1):
            if line.strip() and not line.lstrip().startswith(comment):
                yield number, line.strip()

    def beside(self, *names: str) -> Source | None:
        """The first of these files that lies in the same folder (or in the folder itself)."""
        folder = self.path if self.is_folder else self.path.parent
        return next((Source(folder / name) for name in names if (folder / name).is_file()), None)

    def crs_beside(self) -> tuple[str, str]:
        """The CRS that a .prj of the same name states, and its place; "" for none. A project of Inpho ends so, too."""
        stem = self.path.stem
        found = (
            None if self.is_folder or self.path.suffix.lower() == ".prj" else self.beside(f"{stem}.prj", f"{stem}.qpj")
        )
        text = found.text.strip() if found else ""
        return (text, str(found.path)) if found and _CRS_TEXT.match(text) else ("", "")

    def at(self, line: int, column: str = "") -> str:
        """A place for messages."""
        return f"{self.path}, line {line}" + (f", column {column}" if column else "")


@dataclass(frozen=True)
class Units:
    """Metres of one unit of x and y, of a height, and of accuracies, degrees of one unit of angles, None where nothing
    says so; and all that comments state."""

    across_m: float | None = None
    up_m: float | None = None
    angle_deg: float | None = None
    accuracy_m: float | None = None
    said: Statements = field(default_factory=Statements)

    def remarks(self, source: Source) -> tuple[str, ...]:
        not_whole = [] if self.said.crs else self.said.not_whole
        return tuple(f"{source.path.name}: {words}" for words in (*self.said.remarks, *not_whole))


def units_of_comments(source: Source) -> Units:
    """What the comments of a file without header say. Raises ConfigError where heights do not count from a datum."""
    said = statements_of(source.lines)
    if said.relative:
        raise ConfigError(
            f"{source.path}: {said.relative!r} says that heights do not count from a datum: leave them out, or give "
            "heights above the ellipsoid or sea level"
        )

    def of(kind: Kind, *quantities: Quantity) -> float | None:
        text = said.unit(kind, *quantities)
        return factor(str(source.path), quantities[0], text, kind) if text else None

    return Units(
        of("length", "across", "coordinates", "all"), of("length", "heights", "coordinates", "all"),
        of("angle", "angles", "all"), of("length", "accuracies"), said,
    )  # fmt: skip


@dataclass
class CameraShelf:
    """Cameras of a pose file, by the names that its rows have. remarks: what is to be said of them, each once."""

    file: str
    found: dict[str, Camera] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    def add(self, key: str, lens: Nearest | None) -> None:
        """None: there is none, and nothing to say."""
        if lens is None:
            return
        if lens.camera is not None:
            self.found[key] = lens.camera
        said = remark(lens, f"{self.file}, camera {key}")
        if said and said not in self.remarks:
            self.remarks.append(said)

    def key(self, wanted: str) -> str:
        """The name for a row, "" where there is no such camera."""
        return wanted if wanted in self.found else ""


def coordinate(where: str, cell: str, *, decimal_comma: bool = False) -> float:
    """`number`. Raises ConfigError for one that a spreadsheet has rounded, too."""
    refuse_rounded(where, cell)
    return number(where, cell, decimal_comma=decimal_comma)


def number(where: str, cell: str, *, decimal_comma: bool = False) -> float:
    """Raises ConfigError where the cell is no finite number."""
    text = cell.replace(",", ".") if decimal_comma and cell.count(",") == 1 and "." not in cell else cell
    try:
        value = float(text)
    except ValueError as error:
        raise ConfigError(f"{where}: {cell!r} is not a number") from error
    if not math.isfinite(value):
        raise ConfigError(f"{where}: {cell!r} is not a finite number")
    return value


def is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def numbers(where: str, cells: Sequence[str], names: Sequence[str]) -> list[float]:
    """One number for each name. Raises ConfigError naming the column."""
    if len(cells) < len(names):
        raise ConfigError(f"{where}: {len(cells)} values, {len(names)} are needed: {', '.join(names)}")
    return [number(f"{where}, column {name}", cell) for cell, name in zip(cells, names, strict=False)]


def world_beside(source: Source) -> tuple[str | None, FloatArray]:
    """CRS and origin (3,) that the first world.json or block.json of this program beside a file, or a folder above,
    states; None and zeros where there is none, or a local frame."""
    folder = source.path if source.is_folder else source.path.parent
    for path in (folder / "world.json", folder.parent / "world.json", folder.parent / "block.json"):
        tree = Source(path).tree if path.is_file() else None
        if isinstance(tree, dict) and isinstance(tree.get("crs"), str):
            if tree["crs"] == "local":
                break
            origin = np.array(tree.get("origin_m", (0.0, 0.0, 0.0)), dtype=np.float64)
            if origin.shape == (3,) and np.isfinite(origin).all():
                return tree["crs"], origin
    return None, np.zeros(3)


def image_name(text: str) -> str:
    """As pose lists write it: forward slashes, no leading ./"""
    return re.sub(r"^(\./)+", "", text.strip().strip('"').replace("\\", "/"))


def rotation_row(
    image: str,
    line: int,
    center: Sequence[float] | FloatArray,
    rotation: FloatArray | None,
    kind: PositionKind = "grid",
    *,
    true_north: bool = False,
    camera: str = "",
) -> PoseRow:
    """A row of a projection centre and a matrix cam_from_world (3, 3), relative to the grid or to true north."""
    x, y, z = (float(value) for value in center)
    attitude = None
    if rotation is not None:
        if not np.isfinite(rotation).all() or abs(float(np.linalg.det(rotation)) - 1.0) > 0.01:
            raise ConfigError(f"{image}, line {line}: the rotation is none (its determinant is not 1)")
        attitude = to_quaternion(rotation)
    return PoseRow(
        image=image_name(image), line=line, position=(x, y, z), position_kind=kind, attitude=attitude,
        attitude_kind="none" if attitude is None else "quaternion", camera=camera, true_north=true_north,
    )  # fmt: skip
