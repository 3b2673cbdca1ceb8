"""Peers on this project's rectified views: `opencv-sift@ground` and others."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.config import load
from aeromatch_cli.data import BoolArray, Camera, FloatArray, View
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.warps import source_from_view
from aeromatch_cli.images.views import render_view
from aeromatch_cli.stages import enhance, pairs, simulate
from methods.base import Described, Found, Method, Options, Scene

# A peer is asked for so many times the budget: what it finds where nothing was seen does not count.
_SPARE = 1.5
# Nearer than this to what was not seen a keypoint is one of the mask, not of the ground.
_MARGIN_PX = 5.0


class OnGround:
    """Any peer on the north-up ground view of each image that preset `baseline` makes from the scene's poses.

    The views have colour, for peers that use it. What a view has not seen is filled with the nearest pixels that it
    has, so that the mask's edge draws no keypoints; those in it or within 5 px of it are left out, and the budget is
    cut after that. Places are stored pixels again when the peer matches and verifies them, in its own way.
    """

    def __init__(self, scene: Scene, options: Options, *, peer: Callable[[Scene, Options], Method]) -> None:
        if options.budget != "image":
            raise ConfigError("peers on rectified views have the budget of an image: leave --budget at image")
        self._folder = tempfile.TemporaryDirectory()  # lives as long as this object
        work = Path(self._folder.name)
        self.views = GroundViews(scene, work / "work")
        self.images, self.keypoints = work / "images", options.keypoints
        # ASIFT keeps so many in each of its own views and cuts over all of them.
        self.peer = peer(replace(scene, images=self.images), replace(options, keypoints=round(_SPARE * self.keypoints)))

    def features(self, image: str) -> Described:
        import cv2

        view, picture, seen = self.views.picture(image)
        path = self.images / image
        path.parent.mkdir(parents=True, exist_ok=True)
        # Decoders go by the content, whatever the name; the fastest compression.
        encoded = cv2.imencode(".png", filled(picture, seen)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        path.write_bytes(encoded.tobytes())
        found: Described = self.peer.features(image)
        kept = np.flatnonzero(away_from_unseen(found.places_px, seen, _MARGIN_PX))
        places = self.views.stored_px(image, view, found.places_px[kept])
        usable = np.flatnonzero(on_picture(self.views.camera(image), places))[: self.keypoints]
        return Described(places[usable], found.descriptors[kept[usable]])

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        return self.peer.match(image0, image1, features0, features1)


class GroundViews:
    """The north-up ground view of each image of a scene, as preset `baseline` makes it."""

    def __init__(self, scene: Scene, workspace: Path) -> None:
        block = {"images": str(scene.images), "poses": str(scene.poses), "cameras": str(scene.block)}
        top = {"workspace": str(workspace), "run": {"executor": "serial", "jobs": 1}}
        asked = ["pairs=exhaustive", "extract.colours=true"]  # the views depend on neither
        self.context, _ = pairs.prepare(load("baseline", asked, block, **top), Executor("serial", 1))
        self.image_of = {image.name: image for image in self.context.block.images}

    def camera(self, image: str) -> Camera:
        """Of the stored picture."""
        return self.context.block.camera(self.image_of[image])

    def picture(self, image: str) -> tuple[View, NDArray[np.uint8], BoolArray]:
        """View, colours (H, W, 3) RGB, and where it saw something (H, W)."""
        task = simulate.make_task(self.context, self.image_of[image])
        pixels, valid, _ = enhance.for_views(task.source)
        view = simulate.views_of(task)[-1]
        colours = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
        rendered, seen = render_view(colours, valid, self.camera(image), view)
        return view, rendered, np.ones(rendered.shape[:2], bool) if seen is None else seen

    def stored_px(self, image: str, view: View, points_px: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of points (N, 2) of the view; NaN where the image does not see them."""
        if view.is_source or len(points_px) == 0:
            return np.asarray(points_px, np.float64).reshape(-1, 2)
        return source_from_view(self.camera(image), view.undistorted_from_view, points_px)


def filled(picture: NDArray[np.uint8], seen: BoolArray) -> NDArray[np.uint8]:
    """The picture (H, W, 3) with the nearest seen pixel in the place of each that is not."""
    import cv2

    if seen.all() or not seen.any():
        return picture
    unseen = (~seen).astype(np.uint8)
    found: Any = cv2.distanceTransformWithLabels(unseen, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    labels = found[1]
    at = np.zeros(int(labels.max()) + 1, np.int64)
    at[labels[seen]] = np.flatnonzero(seen)
    out: Any = picture.reshape(-1, 3)[at[labels.ravel()]].reshape(picture.shape)
    return np.asarray(out)


def away_from_unseen(points_px: FloatArray, seen: BoolArray, margin_px: float | FloatArray) -> BoolArray:
    """Which points (N, 2) of a view lie farther than the margin, one or (N,), from what it has not seen (H, W)."""
    import cv2

    distance = cv2.distanceTransform(seen.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    last = np.array(seen.shape[::-1]) - 1
    x, y = np.clip(np.rint(np.asarray(points_px).reshape(-1, 2)), 0, last).astype(np.int64).T
    return np.asarray(seen.all() | (distance[y, x] > margin_px))


def on_picture(camera: Camera, points_px: FloatArray) -> BoolArray:
    """Which stored pixels (N, 2) lie on the picture; NaN do not."""
    last = np.array([camera.width_px, camera.height_px]) - 0.5
    with np.errstate(invalid="ignore"):
        return np.asarray(((points_px >= -0.5) & (points_px <= last)).all(axis=1))
