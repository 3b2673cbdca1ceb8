"""Every method by name."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from aeromatch_cli.config import Settings, load, parse_method, preset_names
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.strategies import Strategy
from benchmarks.peers.aliked import ALIKED, ALIKED_ROTATED, Aliked
from benchmarks.peers.base import Method, Options, Scene, weights_path
from benchmarks.peers.colmap import Colmap
from benchmarks.peers.ground import OnGround
from benchmarks.peers.kornia_peers import HARD_TFEAT, TFEAT, KeyNet
from benchmarks.peers.opencv import OpenCvAsift, OpenCvSift
from benchmarks.peers.ours import Preset
from benchmarks.peers.published import LIGHTERGLUE, Disk, WithLightGlue, XFeat
from benchmarks.peers.union import Union

Make = Callable[[Scene, Options], Method]


def _superpoint(scene: Scene, options: Options) -> Method:
    """Its class needs torch as soon as it is read; names are needed without."""
    from benchmarks.peers.superpoint import SuperPoint

    return SuperPoint(scene, options)


_OF_ALIKED, _OF_DISK = "aliked_lightglue.pth", "disk_lightglue.pth"
# Peers that look at the stored pictures, and have `candidates`.
FROM_PICTURES: Mapping[str, Make] = {
    "opencv-sift": OpenCvSift,
    "opencv-asift": OpenCvAsift,
    "aliked": Aliked,
    "keynet": KeyNet,
    "keynet-tfeat": partial(KeyNet, descriptor=TFEAT),
    "superpoint": _superpoint,
    "aliked+lightglue": partial(WithLightGlue, features=partial(Aliked, model=ALIKED), weights=_OF_ALIKED),
    "aliked-rot+lightglue": partial(WithLightGlue, features=Aliked, weights=_OF_ALIKED),
    "disk+lightglue": partial(WithLightGlue, features=Disk, weights=_OF_DISK),
    "xfeat+lighterglue": partial(WithLightGlue, features=XFeat, **LIGHTERGLUE),
}
ON_GROUND, TOTAL = "@ground", ":total"


def _at_total(scene: Scene, options: Options, *, peer: Make) -> Method:
    """With as many descriptors as the features of `auto` have together."""
    return peer(scene, replace(options, keypoints=2 * options.keypoints))


_ALSO_AT_TOTAL = ("aliked+lightglue", "aliked+lightglue@ground")
_OF_ONE_BUDGET: Mapping[str, Make] = {
    **FROM_PICTURES,
    "pycolmap": Colmap,
    "pycolmap-guided": partial(Colmap, guided=True),
    **{f"{name}{ON_GROUND}": partial(OnGround, peer=make) for name, make in FROM_PICTURES.items()},
}
PEERS: Mapping[str, Make] = {
    **_OF_ONE_BUDGET,
    **{f"{name}{TOTAL}": partial(_at_total, peer=_OF_ONE_BUDGET[name]) for name in _ALSO_AT_TOTAL},
    "pycolmap+aliked": partial(Union, first=partial(Colmap, guided=True), second=FROM_PICTURES["aliked+lightglue"]),
}


def _features_of(spec: str) -> str:
    """The name without what says how they are used."""
    return spec.removesuffix(TOTAL).removesuffix(ON_GROUND)


# Peers that are networks: the files of their weights.
_KEYNET = ("OriNet.pth", "keynet_pytorch.pth")
_WEIGHTS: Mapping[str, tuple[str, ...]] = {
    "aliked": (f"{ALIKED_ROTATED}.pth",),
    "keynet": (*_KEYNET, HARD_TFEAT),
    "keynet-tfeat": (*_KEYNET, TFEAT),
    "superpoint": ("superpoint_v1.pth",),
    "aliked+lightglue": (f"{ALIKED}.pth", _OF_ALIKED),
    "aliked-rot+lightglue": (f"{ALIKED_ROTATED}.pth", _OF_ALIKED),
    "disk+lightglue": ("disk-depth-save.pth", _OF_DISK),
    "xfeat+lighterglue": ("xfeat.pt", LIGHTERGLUE["weights"]),
    "pycolmap+aliked": (f"{ALIKED}.pth", _OF_ALIKED),
}
NEED_WEIGHTS = tuple(name for name in PEERS if _features_of(name) in _WEIGHTS)


def missing_weights(spec: str, folder: Path | None) -> list[str]:
    """Names of files without which a method cannot be run; folder: of reference weights. Those of a preset lie in the
    weights folder, or in an installed package."""
    if spec not in PEERS:
        settings = load(*parse_method(spec))
        return [f"the weights of {part.name}" for part in (settings.extract, settings.match) if not _has_weights(part)]
    files = _WEIGHTS.get(_features_of(spec), ())
    return [name for name in files if weights_path(folder, name) is None]


def _has_weights(part: Strategy) -> bool:
    try:
        part.fingerprint_files()
    except ConfigError:
        return False
    return True


def reads_poses(spec: str) -> bool:
    """Whether a method's answers depend on the poses: presets, and peers on rectified views."""
    return spec not in PEERS or spec.removesuffix(TOTAL).endswith(ON_GROUND)


def by_block(spec: str) -> bool:
    """Whether a method is a preset whose further steps are for the pairs of a block that need them."""
    return spec not in PEERS and bool(load(*parse_method(spec)).cascade)


@dataclass(frozen=True)
class Named:
    """A method as it is asked for. label: in tables and rows. spec: a peer, or PRESET[key=value,...]."""

    label: str
    spec: str


def named_methods(text: str) -> list[Named]:
    """The methods between commas, each with a label before it or not: 'opencv-sift,plain=fusion[enhance=none]'.

    Raises ConfigError where a label stands for two methods, or is the name of another one.
    """
    found: dict[str, Named] = {}
    for part in split_methods(text):
        match = re.fullmatch(r"(?:([^\[\]=|`]+)=)?([^\[\]=]+(?:\[.*\])?)", part)
        if match is None:
            raise ConfigError(f"{part!r} is not a method; write a peer, PRESET[key=value] or LABEL=PRESET[key=value]")
        spec = match[2].strip()
        label = (match[1] or spec).strip()
        if label != spec and label in (*PEERS, *preset_names()):
            raise ConfigError(f"{part!r}: {label} is a method itself; take another label")
        if label in found:
            raise ConfigError(f"{label} stands for {found[label].spec} and for {spec}; labels must differ")
        found[label] = Named(label, spec)
    return list(found.values())


def method(text: str) -> Make:
    """How to make the method that `text` names. Raises ConfigError as `check_method`; nothing is run yet."""
    check_method(text)
    name, settings = parse_method(text)
    return PEERS[name] if name in PEERS else partial(Preset, preset=name, settings=tuple(settings))


def check_method(text: str, peers: Collection[str] = PEERS) -> None:
    """Raises ConfigError where it is neither a peer nor PRESET[key=value,...] with settings that there are."""
    name, settings = parse_method(text)
    if name in peers:
        if settings:
            raise ConfigError(f"{text!r}: the peer {name} has no settings; only presets have")
    elif name not in preset_names():
        choices = f"peers are {', '.join(peers)}; presets are {', '.join(preset_names())}"
        raise ConfigError(f"{name!r} is no method; {choices}")
    else:
        load(name, settings)


def settings_of(names: Iterable[Named]) -> list[Settings]:
    """Of those that are presets."""
    specs = (parse_method(name.spec) for name in names)
    return [load(preset, settings) for preset, settings in specs if preset in preset_names()]


def split_methods(text: str) -> list[str]:
    """Names between commas; commas inside brackets belong to the method."""
    parts, depth = [""], 0
    for character in text:
        depth += (character == "[") - (character == "]")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]
