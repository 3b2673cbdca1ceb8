"""Images that are left out: those that the user names, and those that were taken on the ground.

The user names images, patterns, or files with one of these in each line. On the ground, pictures of a reflectance panel
are taken, and some before take-off or after landing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Sized
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.other_files import image_suffixes
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes, text_encoding
from aeromatch_cli.words import listed, of_images

# Of one image, of several.
_PANEL = "shows a reflectance panel by its XMP", "show a reflectance panel by their XMP"
_ON_GROUND = "was taken on the ground by its height", "were taken on the ground by their heights"
_METRES_PER_DEGREE = 111_320.0
# Those on the ground lie within so many metres of each other in height, and so far below all others.
_LEVEL_M, _GAP_M = 3.0, 10.0
# They lie at one place, are no more than this share of a block, and a block has so many images.
_PLACE_M, _SHARE, _LEAST_IMAGES = 20.0, 0.2, 6


def list_files(text: str) -> list[Path]:
    """Files among the entries of `excluded`; what has the suffix of an image is the name of one."""
    paths = [Path(entry) for entry in _entries(text)]
    return [path for path in paths if path.suffix.lower() not in image_suffixes() and path.is_file()]


def excluded(text: str, names: Sequence[str]) -> tuple[frozenset[str], list[str]]:
    """Those of the images (relative paths) that the user leaves out, and remarks.

    text: names, patterns such as `takeoff/*` or `*_0001.jpg`, and files with lines of these, separated by commas. Each
    is compared with the whole path and with the name alone, whatever their case; of a line with commas the first cell
    counts, and # begins a comment. Raises ConfigError where a file cannot be read.
    """
    found, idle = set[str](), list[str]()
    files = set(list_files(text))
    for entry in _entries(text):
        for pattern in _lines(Path(entry)) if Path(entry) in files else [entry]:
            wanted = pattern.replace("\\", "/").removeprefix("./").lower()
            hits = [name for name in names if _fits(name.lower(), wanted)]
            found.update(hits)
            idle += [] if hits else [pattern]
    remarks = []
    if found:
        remarks.append(f"{of_images(sorted(found), names, 'is', 'are')} left out, as --exclude asks")
    if idle:
        remarks.append(f"--exclude fits no image of the folder: {listed(idle)}")
    return frozenset(found), remarks


def _entries(text: str) -> list[str]:
    return [entry.strip() for entry in text.split(",") if entry.strip()]


def _fits(name: str, wanted: str) -> bool:
    return any(one == wanted or fnmatchcase(one, wanted) for one in (name, name.rpartition("/")[2]))


def _lines(path: Path) -> list[str]:
    try:
        raw = given_bytes(path)
        text = raw.decode(text_encoding(raw))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--exclude {path} cannot be read ({error}): give a text file of names") from error
    cells = (line.partition("#")[0].partition(",")[0].strip().strip("\"'") for line in text.splitlines())
    return [cell for cell in cells if cell]


def ground_shots(facts: Mapping[str, ExifFacts]) -> dict[str, tuple[str, str]]:
    """Image name -> why it counts as taken on the ground, in words that go on "it", and in those that go on "they".
    facts: by image name."""
    found = {name: _PANEL for name, fact in facts.items() if fact.panel}
    rest = {name: fact for name, fact in facts.items() if name not in found}
    return found | dict.fromkeys(_standing(rest), _ON_GROUND)


def remarks_on_ground_shots(shots: Mapping[str, tuple[str, str]], of_all: Sized, *, dropped: bool) -> list[str]:
    """Return one sentence for every reason that `ground_shots` has."""
    remedy = "left out" if dropped else "leave them out with --set block.ground_shots=drop"
    remarks = []
    for reason in dict.fromkeys(shots.values()):
        names = [name for name, one in shots.items() if one == reason]
        remarks.append(f"{of_images(names, of_all, *reason)}: {remedy}")
    return remarks


def _standing(facts: Mapping[str, ExifFacts]) -> list[str]:
    """Those that stand at the take-off point: where heights above it are known they are 0, else the lowest ones."""
    above_takeoff = all(fact.relative_altitude_m is not None for fact in facts.values())
    heights_m = {}
    for name, fact in facts.items():
        height_m = fact.relative_altitude_m if above_takeoff else fact.altitude_m
        if height_m is not None:
            heights_m[name] = height_m
    if len(heights_m) < _LEAST_IMAGES:
        return []
    zero_m = 0.0 if above_takeoff else min(heights_m.values())
    off_m = {name: abs(height_m - zero_m) for name, height_m in heights_m.items()}
    low = [name for name, apart_m in off_m.items() if apart_m <= _LEVEL_M]
    if not low or len(low) > _SHARE * len(heights_m):
        return []
    others_m = [apart_m for apart_m in off_m.values() if not apart_m <= _LEVEL_M]
    # Without heights above take-off nothing says where the ground is, and one of images at many heights is the lowest.
    spread_m = 0.0 if above_takeoff else max(others_m) - min(others_m)
    if min(others_m) < max(_GAP_M, spread_m):
        return []
    if above_takeoff or _at_one_place([facts[name] for name in low]):
        return low
    return []


def _at_one_place(facts: list[ExifFacts]) -> bool:
    places = np.array([[fact.latitude_deg, fact.longitude_deg] for fact in facts], dtype=float)
    places = places[np.isfinite(places).all(axis=1)]
    if len(places) == 0:
        return False
    places[:, 1] *= math.cos(math.radians(float(places[0, 0])))
    return bool(np.linalg.norm(np.ptp(places, axis=0)) * _METRES_PER_DEGREE <= _PLACE_M)
