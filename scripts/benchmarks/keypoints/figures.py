"""What is compared, by name (NAME, LABEL=NAME, or LABEL=NAME:FILE with weights of one's own), and figures on disk: what
depends on nothing that changed is not made again, so that a killed run goes on."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.fingerprints import file_digest, fingerprint
from benchmarks.peers.base import Options
from benchmarks.scenes import Judged, JudgedPair
from benchmarks.sources import GROUND_CODE, OUR_CODE, code_digest, library_versions
from benchmarks.tables import Row


@dataclass(frozen=True)
class Named:
    """label: in tables and rows. name: of the table it is made from. weights: a file, or None."""

    label: str
    name: str
    weights: Path | None


def named(text: str, known: Mapping[str, Any]) -> list[Named]:
    """The methods between commas. Raises ConfigError on an unknown name and on a label that occurs twice."""
    found: dict[str, Named] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        head, _, weights = part.partition(":")
        label, _, name = head.rpartition("=")
        one = Named(label or name, name, Path(weights) if weights else None)
        if name not in known:
            raise ConfigError(f"{name!r} is none of {', '.join(known)}")
        if one.label in found:
            raise ConfigError(f"{one.label} stands for two methods; give labels: LABEL={name}")
        found[one.label] = one
    return list(found.values())


def without_paths(text: str) -> str:
    """The same names, FILE in the place of weights."""
    return re.sub(r":[^,]+", ":FILE", text)


def make(table: Mapping[str, Callable[..., Any]], method: Named, options: Options) -> Any:
    """What a name stands for, made."""
    if method.weights is None:
        return table[method.name](options)
    if not method.weights.is_file():
        raise ConfigError(f"weights {method.weights} not found")
    return table[method.name](options, weights=method.weights)


# What figures depend on; "ours" is made by more of the package than the others.
_CODE = (*GROUND_CODE, "benchmarks/keypoints", "strategies/extractors/pyramid.py", "lab/surfaces.py")
_OWN = "ours"


@dataclass(frozen=True)
class Asked:
    """keypoints: of either side of a pair. upright: descriptors at angle 0 instead of SIFT's own."""

    keypoints: int
    seed: int
    upright: bool = True


class Store:
    """A folder with a file of figures for every method and pair. settings: what else the figures depend on."""

    def __init__(self, folder: Path, settings: Any) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._basis = fingerprint(settings, library_versions())
        self._digests = {True: code_digest(*_CODE, *OUR_CODE), False: code_digest(*_CODE)}

    def row(
        self, judged: Judged, pair: JudgedPair, section: str, frame: str, method: Named, make: Callable[[], Row]
    ) -> Row:
        """The row of a method on a pair: facts of the pair, then figures, made where there are none."""
        weights = None if method.weights is None else file_digest(method.weights)
        code = self._digests[method.name.startswith(_OWN)]
        key = fingerprint(self._basis, code, judged.key, pair.images, section, frame, method.name, weights)[:16]
        facts: Row = {
            "section": section,
            "method": method.label,
            "frame": frame,
            "scene": judged.scene.name,
            "pair": " ".join(pair.images),
            "view_angle_deg": round(pair.conditions.view_angle_deg, 3),
            "overlap": round(pair.conditions.overlap, 4),
        }
        path = self._folder / f"{key}.json"
        if not path.is_file():
            write_json(path, make())
        return facts | read_json(path) | {"key": key}
