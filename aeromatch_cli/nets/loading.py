"""Weights files into networks: strictly, for evaluation."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.files import content_stamp, read_tensors
from aeromatch_cli.nets.precision import Precision, layer_type
from aeromatch_cli.words import listed

Network = TypeVar("Network", bound=nn.Module)
P = ParamSpec("P")
R = TypeVar("R")


def once_per_file(load: Callable[P, R]) -> Callable[P, R]:
    """A loader, whose first argument is the file's path or None, that loads once per process and anew where the file
    was replaced."""

    @lru_cache(maxsize=4)
    def cached(stamp: tuple[int, int] | None, args: tuple[Any, ...], named: tuple[tuple[str, Any], ...]) -> R:
        del stamp
        again: Callable[..., R] = load
        return again(*args, **dict(named))

    @wraps(load)
    def loader(*args: P.args, **kwargs: P.kwargs) -> R:
        path = args[0] if args else kwargs.get("path")
        return cached(content_stamp(path) if isinstance(path, Path) else None, args, tuple(sorted(kwargs.items())))

    return loader


def load_network(
    make: Callable[[Mapping[str, Tensor]], Network], path: Path, precision: Precision = "float32", device: str = "cpu"
) -> Network:
    """What `make` makes for a file's tensors, with these weights in this precision, on "cpu" or "cuda", for evaluation.

    Every tensor comes from the file and every tensor of the file is used; raises ConfigError otherwise. The global
    generator stays as it was.
    """
    given = read_tensors(path)
    with torch.random.fork_rng(devices=[]):
        network = make(given)
    try:
        check_same_tensors(network.state_dict(), given)
    except ValueError as error:
        raise ConfigError(f"weights file {path} does not fit {type(network).__name__}: {error}") from error
    network.load_state_dict(given, strict=True)
    return network.to(device=device, dtype=layer_type(precision, device)).eval().requires_grad_(False)


def check_same_tensors(
    expected: Mapping[str, Tensor], given: Mapping[str, Tensor], optional: Collection[str] = ()
) -> None:
    """Raises ValueError that names what a network wants and was not given, or the other way round, and other shapes.

    optional: names that either may have or leave out.
    """
    missing = sorted(expected.keys() - given.keys() - set(optional))
    unexpected = sorted(given.keys() - expected.keys() - set(optional))
    shapes = [
        f"{key} {tuple(given[key].shape)} instead of {tuple(expected[key].shape)}"
        for key in sorted(expected.keys() & given.keys())
        if expected[key].shape != given[key].shape
    ]
    problems = [
        f"{what}: {listed(keys)}"
        for what, keys in (("missing", missing), ("unexpected", unexpected), ("wrong shape", shapes))
        if keys
    ]
    if problems:
        raise ValueError("; ".join(problems))
