"""Peers on this project's rectified views: `opencv-sift@ground` and others."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.images.views import render_view
from aeromatch_cli.stages import enhance, simulate
from benchmarks.peers.base import Described, Found, Method, Options, Scene, prepared
from benchmarks.views import ImageView, away_from_unseen, filled, inside

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

        view, picture, seen = self.views(image)
        path = self.images / image
        path.parent.mkdir(parents=True, exist_ok=True)
        # Decoders go by the content, whatever the name; the fastest compression.
        encoded = cv2.imencode(".png", filled(picture, seen)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        path.write_bytes(encoded.tobytes())
        found: Described = self.peer.features(image)
        kept = np.flatnonzero(away_from_unseen(found.places_px, seen, _MARGIN_PX))
        places = view.stored_px(found.places_px[kept])
        usable = np.flatnonzero(inside(places, view.camera))[: self.keypoints]
        rows = kept[usable]
        return Described(places[usable], found.descriptors[rows], found.places_px[rows], found.size_px)

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        return self.peer.match(image0, image1, features0, features1)


class GroundViews:
    """The north-up ground view of each image of a scene, as preset `baseline` makes it."""

    def __init__(self, scene: Scene, workspace: Path) -> None:
        asked = ["pairs=exhaustive", "extract.colours=true"]  # the views depend on neither
        self.context = prepared("baseline", asked, scene.images, scene.poses, scene.block, workspace)
        self.image_of = {image.name: image for image in self.context.block.images}

    def __call__(self, image: str) -> tuple[ImageView, NDArray[np.uint8], BoolArray]:
        """View, colours (H, W, 3) RGB, and where it saw something (H, W)."""
        task = simulate.make_task(self.context, self.image_of[image])
        pixels, valid, _ = enhance.for_views(task.enhance)
        view = simulate.views_of(task)[-1]
        colours = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
        camera = self.context.block.camera(self.image_of[image])
        rendered, seen = render_view(colours, valid, camera, view)
        seen = np.ones(rendered.shape[:2], bool) if seen is None else seen
        return ImageView(image, camera, view), rendered, seen
