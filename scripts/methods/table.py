"""Every method by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from aeromatch_cli.config import load, parse_method, preset_names
from aeromatch_cli.errors import ConfigError
from methods.aliked import Aliked
from methods.base import Method, Options, Scene
from methods.colmap import Colmap
from methods.keynet import KeyNet
from methods.opencv_asift import OpenCvAsift
from methods.opencv_sift import OpenCvSift
from methods.ours import Preset

Make = Callable[[Scene, Options], Method]

PEERS: Mapping[str, Make] = {
    "opencv-sift": OpenCvSift,
    "opencv-asift": OpenCvAsift,
    "pycolmap": Colmap,
    "pycolmap-guided": partial(Colmap, guided=True),
    "aliked": Aliked,
    "keynet": KeyNet,
    "keynet-tfeat": partial(KeyNet, descriptor="tfeat-liberty.params"),
}
NEED_WEIGHTS = ("aliked", "keynet", "keynet-tfeat")


def method(text: str) -> Make:
    """How to make the method that `text` names: a peer, or PRESET[key=value,...].

    Raises ConfigError on an unknown name or setting; nothing is run yet.
    """
    name, settings = parse_method(text)
    if name in PEERS:
        if settings:
            raise ConfigError(f"{text!r}: the peer {name} has no settings; only presets have")
        return PEERS[name]
    if name not in preset_names():
        choices = f"peers are {', '.join(PEERS)}; presets are {', '.join(preset_names())}"
        raise ConfigError(f"{name!r} is no method; {choices}")
    load(name, settings)
    return partial(Preset, preset=name, settings=tuple(settings))


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
