"""What the views of an image cost: how many, how large, and the seconds of its features."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.config import parse_method
from aeromatch_cli.workspace import read_json
from methods.base import Options, Scene
from methods.goal_tables import markdown, number
from methods.ours import Preset
from methods.table import Named


@dataclass(frozen=True)
class ViewCost:
    """Of one image. pixels: of all views over those of the image. seconds: decoding to features on file."""

    method: str
    scene: str
    views: int
    pixels: float
    descriptors: int
    seconds: float


def view_costs(name: Named, scene: Scene, options: Options) -> list[ViewCost]:
    """Every image of the scene's judged pairs; the first one is run once before, untimed."""
    preset, settings = parse_method(name.spec)
    method = Preset(scene, options, preset=preset, settings=tuple(settings))
    images = sorted({image for pair in scene.pairs for image in pair})
    method.features(images[0])
    costs = []
    for image in images:
        started = time.perf_counter()
        features = method.features(image)
        seconds = time.perf_counter() - started
        views = read_json(method.context.workspace.views(method.id_of[image]))["views"]
        camera = scene.cameras[image]
        pixels = sum(view["width_px"] * view["height_px"] for view in views) / (camera.width_px * camera.height_px)
        costs.append(ViewCost(name.label, scene.name, len(views), pixels, len(features.descriptors), seconds))
    return costs


def cost_table(costs: list[ViewCost]) -> str:
    """A line per method, over the images of all scenes."""
    columns = (
        "method", "images", "views an image, mean", "most", "pixels of all views / image, mean", "most",
        "descriptors, mean", "seconds an image, median", "most",
    )  # fmt: skip
    lines = []
    for method in dict.fromkeys(cost.method for cost in costs):
        own = [cost for cost in costs if cost.method == method]
        views, pixels, seconds = (np.array([getattr(c, key) for c in own]) for key in ("views", "pixels", "seconds"))
        cells = [str(len(own)), number(float(views.mean()), 1), str(int(views.max()))]
        cells += [number(float(pixels.mean()), 2), number(float(pixels.max()), 2)]
        cells += [f"{np.mean([cost.descriptors for cost in own]):.0f}"]
        cells += [number(float(np.median(seconds)), 2), number(float(seconds.max()), 2)]
        lines.append([f"`{method}`", *cells])
    return markdown(columns, lines)
