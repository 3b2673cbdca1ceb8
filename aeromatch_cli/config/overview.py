"""What can be chosen: presets, families of strategies, and a first settings file for a folder of images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from aeromatch_cli import DEFAULT_PRESET
from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.control_files import read_survey
from aeromatch_cli.blocks.exif import ExifFacts, exif_or_reason
from aeromatch_cli.blocks.image_names import matched_names, matched_rows
from aeromatch_cli.blocks.other_files import KINDS
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.blocks.scan import scan_images
from aeromatch_cli.config.faults import nearest
from aeromatch_cli.config.load import differences_of_preset, load, preset_names
from aeromatch_cli.config.schema import FAMILIES, Settings
from aeromatch_cli.config.text import first_sentence, scalar
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.words import counted

_PRESETS = "presets"
# So many headers tell what the others hold.
_LOOKED_AT = 20
# Files that may hold poses, by suffix: others are not opened.
_POSE_SUFFIXES = (".csv", ".txt", ".json", ".geojson", ".xml", ".mrk", ".prj", ".ori", ".nvm", ".out", ".bin")
_LARGEST_BYTES = 50_000_000
_CONTROL_SUFFIXES = (".csv", ".txt", ".xml")
_CAMERA_FILES = ("cameras.txt", "cameras.json", "cameras.yaml", "cameras.yml", "block.json")


def listing(family: str = "") -> list[str]:
    """Presets with their purpose and every family with its strategies; of one family alone where it is named.

    Raises ConfigError where there is no such family.
    """
    found = choices(family)
    lines: list[str] = []
    if "presets" in found:
        lines += ["presets: aeromatch run PRESET", *_table({one["name"]: one["words"] for one in found["presets"]})]
    for name, strategies in found["families"].items():
        title = f"{name}: --set {name}={strategies[0]['name']}"
        lines += ["", title, *_table({f"{s['name']} *" if s["default"] else s["name"]: s["words"] for s in strategies})]
    return lines if family == _PRESETS else [*lines, "", f"* used by default (preset {DEFAULT_PRESET})"]


def choices(family: str = "") -> dict[str, Any]:
    """The same for machines: presets [{name, words}], and families -> [{name, words, default}].

    Raises ConfigError where there is no such family.
    """
    if family and family not in (_PRESETS, *FAMILIES):
        hint = nearest(family, (_PRESETS, *FAMILIES), otherwise="")
        raise ConfigError(f"no family is called {family!r}: there are {', '.join((_PRESETS, *FAMILIES))}{hint}")
    found: dict[str, Any] = {}
    if family in ("", _PRESETS):
        found["presets"] = [{"name": name, "words": words} for name, words in _purposes().items()]
    used = load(DEFAULT_PRESET)
    found["families"] = {
        name: [
            {"name": key, "words": first_sentence(table[key]), "default": key in _names(used, name)} for key in table
        ]
        for name, table in FAMILIES.items()
        if family in ("", name)
    }
    return found


def _purposes() -> dict[str, str]:
    order = sorted(preset_names(), key=lambda name: (name != DEFAULT_PRESET, name))
    return {name: differences_of_preset(name)[0] for name in order}


def _names(settings: Settings, family: str) -> set[str]:
    """Of the strategies that settings take of a family."""
    value = getattr(settings, family)
    return {one.name for one in (value if isinstance(value, tuple) else (value,))}


def _table(rows: Mapping[str, str]) -> list[str]:
    width = max(map(len, rows), default=0)
    return [f"  {name:<{width}}  {words}" for name, words in rows.items()]


def first_settings(images: Path, folder: Path) -> tuple[str, list[str]]:
    """A YAML settings file for these images, commented, and what was seen, in words. folder: where it will lie.

    Raises InputError where the folder holds no image.
    """
    names, passed_over = scan_images(images, [])
    if not names:
        said = f": {passed_over[0].name}: {passed_over[0].reason}" if passed_over else ": check --images"
        raise InputError(f"no image ({KINDS}) in {images}{said}")
    looked = [exif_or_reason(images / name) for name in names[:: max(1, len(names) // _LOOKED_AT)][:_LOOKED_AT]]
    facts = [fact for fact in looked if isinstance(fact, ExifFacts)]
    found = [counted(len(names), "image"), *_seen(facts)]
    poses = _pose_files(images, names)
    control = next(_control_files(images, names), None)
    cameras = next(_camera_files(images), None)
    found += [f"pose file {path}: {title}" for path, title in poses]
    found += [f"camera file {cameras}"] if cameras else []
    found += [f"control points {control}"] if control else []
    below = [(_below(path, folder), title) for path, title in poses]
    camera_file = _below(cameras, folder) if cameras else "exif"
    gcp = _below(control, folder) if control else ""
    return _settings_text(_below(images, folder), facts, below, camera_file, gcp, found), found


def _below(path: Path, folder: Path) -> str:
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return str(path.resolve())


def _seen(facts: list[ExifFacts]) -> Iterator[str]:
    """Cameras, positions and angles of the headers that were looked at."""
    cameras = Counter(
        f"{' '.join(filter(None, (fact.make, fact.model))) or 'of unknown make'} {fact.width_px} x {fact.height_px}"
        for fact in facts
    )
    for camera, _ in cameras.most_common(5):
        yield f"camera {camera}"
    positions, angles = sum(f.latitude_deg is not None for f in facts), sum(f.angles is not None for f in facts)
    if facts:
        yield f"GPS position in {positions} of {len(facts)} headers, angles in {angles}"


def _pose_files(images: Path, names: list[str]) -> list[tuple[Path, str]]:
    """Files in the folder and beside it whose lines mean these images, the one that means most of them first, and what
    they are."""
    found = []
    for path in _candidates(images, _POSE_SUFFIXES):
        try:
            pose_list = read_pose_file(path)
            rows, _ = matched_rows(pose_list, names, path.name)
        except ConfigError:
            continue  # another file, or poses of other images
        found.append((len(rows), path, pose_list.format))
    found.sort(key=lambda one: -one[0])
    return [(path, f"{title}, {count} of {len(names)} images") for count, path, title in found]


def _control_files(images: Path, names: list[str]) -> Iterator[Path]:
    """Files in the folder and beside it whose control points are measured in these images."""
    for path in _candidates(images, _CONTROL_SUFFIXES):
        try:
            survey = read_survey(path, None)
            measured, _ = matched_names({mark.image: mark.line for mark in survey.marks}, names, path.name)
        except ConfigError:
            continue
        if measured and survey.points:
            yield path


def _candidates(images: Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    for folder in dict.fromkeys((images, images.parent)):
        for path in sorted(folder.iterdir()):
            if path.is_file() and path.suffix.lower() in suffixes and path.stat().st_size <= _LARGEST_BYTES:
                yield path


def _camera_files(images: Path) -> Iterator[Path]:
    """Files in the folder and beside it that --cameras takes."""
    for folder in dict.fromkeys((images, images.parent)):
        for name in _CAMERA_FILES:
            path = folder / name
            try:
                if path.is_file() and read_camera_file(path).cameras:
                    yield path
            except ConfigError:
                continue  # a file of that name that another program has written


def _settings_text(
    images: str, facts: list[ExifFacts], poses: list[tuple[str, str]], cameras: str, gcp: str, found: list[str]
) -> str:
    located = any(fact.latitude_deg is not None for fact in facts)
    chosen = "exif" if located else "none"
    if poses:
        chosen, _ = poses[0]
    others = "".join(f"  # poses: {scalar(path)}  # {title}\n" for path, title in poses[1:])
    seen = "".join(f"#   {line}\n" for line in found)
    return f"""# Settings of aeromatch for one block: aeromatch run FILE. Paths are relative to this file.
{seen}
# Every setting: aeromatch config, docs/configuration.md. Presets and strategies: aeromatch list.
preset: {DEFAULT_PRESET}
workspace: work

block:
  images: {scalar(images)}
  # A pose file of any program, exif (GPS and angles of the images), or none.
  poses: {scalar(chosen)}
{others}  # exif, folder (one camera per folder), or a file: COLMAP's cameras.txt, YAML, JSON.
  cameras: {scalar(cameras)}
  # auto: the UTM zone of the positions, or what the pose file states.
  crs: auto
  # Metres, a DEM file, or auto: the terrain that the pictures show.
  ground: auto
  # Folder of masks in COLMAP's naming, or one mask for all images.
  # masks: masks
  # Ground control points (ODM's gcp_list.txt, or files of Pix4D or Metashape).
  {f"gcp: {scalar(gcp)}" if gcp else "# gcp: gcp_list.txt"}

# More keypoints: more matches, more time.
# extract: {{keypoints: 12000}}

export: colmap
# export: colmap+opensfm+geojson
"""


def whole_settings(tree: Mapping[str, Any]) -> str:
    """A tree of settings as YAML."""
    import yaml

    return yaml.safe_dump(dict(tree), sort_keys=False, width=100, allow_unicode=True)
