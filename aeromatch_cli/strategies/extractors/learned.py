"""Learned keypoints, orientations and descriptors on every view of an image.

A heat map network finds the keypoints, an orientation network turns them where a view does not have north up, GeoDesc
describes a patch of learned place, size and turn, and a context network adds what is around it. Trained by
scripts/train detector, orientation, descriptor and context (nets/trained/*.md).

Source: Deep learning feature matching of oblique images, J. Geo-inf. Sci. 2021(10), 1823-1837; Luo et al., GeoDesc,
ECCV 2018; Tian et al., L2-Net, CVPR 2017; Luo et al., ContextDesc, CVPR 2019.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.descriptor_bytes import as_bytes
from aeromatch_cli.nets.precision import DEVICE, Device, Precision, check_device, device_of
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.context import with_context
from aeromatch_cli.strategies.extractors.described import Described, pixels_field
from aeromatch_cli.strategies.extractors.detection import Raw, balanced, detect, sift_detector
from aeromatch_cli.strategies.extractors.gradients import gradient_angles
from aeromatch_cli.strategies.extractors.heat import heat_keypoints
from aeromatch_cli.strategies.extractors.pyramid import cut_patches, levels_of

# Keypoints of a view that the even spread chooses from, for each that it may keep.
_CHOICE = 8


class Learned(Described):
    """Keypoints, orientations and descriptors by networks that are trained on aerial images."""

    version: ClassVar[int] = 8
    network: ClassVar[bool] = True
    descriptors: ClassVar[str] = "GeoDesc"
    name: Literal["learned"] = "learned"
    # What halving does at so many pixels per keypoint, matches and extraction's seconds: 3,000 (rendered suburb and
    # hills of 12 megapixels): 7 and 50 % more correct ones at 0.36 and 0.41 of the seconds, errors of 0.24 and 0.18
    # px -> 0.46 and 0.34 px; 1,990 and 1,500 (ochota and lewis, within 3 px of the reference): a quarter and a third
    # more in half the seconds; 750 (rendered suburb): 10 % fewer, 0.18 -> 0.44 px.
    pixels_per_keypoint: float = pixels_field(1500.0)
    detector: Literal["network", "sift"] = Field(
        "network",
        description="Keypoints from the maxima of the detector network's heat maps of several scales, or from SIFT.",
    )
    orientation: Literal["auto", "network", "gradient", "upright"] = Field(
        "auto",
        description="Rotate patches by the orientation network (network), by the main direction of their gradients "
        "(gradient), or not at all (upright). auto: by the network, upright in views that have north up.",
    )
    context: bool = Field(
        False,
        description="Correct descriptors by their surroundings (image context and neighbouring keypoints); more time.",
    )
    weights: str | None = Field(
        None,
        description="Folder with your own detector, orientation, geodesc or context .safetensors files, as "
        "scripts/train writes them; files that it lacks are taken from the package.",
        json_schema_extra={"path": True},
    )
    precision: Precision = Field(
        "auto",
        description="Number type of the networks' layers; auto is bfloat16 where the processor has it. Features "
        "depend on it: set it explicitly for shards on different processors.",
    )
    device: Device = DEVICE

    @property
    def north_up_only(self) -> bool:
        """Upright descriptors of views with north up match no others."""
        return self.orientation == "auto"

    def fingerprint_files(self) -> tuple[str, ...]:
        """The weights of the networks that this recipe asks. Raises ConfigError where one is missing."""
        return tuple(str(self._path(name)) for name in self._asked())

    def check_files(self, descriptor_length: int) -> None:
        """Weights of a user are loaded once; the device is looked for."""
        from aeromatch_cli.nets.files import ships

        super().check_files(descriptor_length)
        check_device(self.device)
        if self.weights is None:
            return
        folder = Path(self.weights).expanduser()
        if not folder.is_dir():
            wrong = "is a file; give its folder" if folder.exists() else "is no folder"
            raise ConfigError(f"extract.weights {self.weights!r} {wrong}")
        own = self._own_names()
        if not own:
            raise ConfigError(
                f"extract.weights {self.weights!r} holds none of the files that this recipe reads: "
                + ", ".join(f"{name}.safetensors" for name in self._asked())
            )
        for name in own:
            self._network(name)
        if self.context and "geodesc" in own and "context" not in own and not ships(self._path("geodesc")):
            raise ConfigError(
                f"extract.weights {self.weights!r} holds descriptors of your own, geodesc.safetensors, and no "
                "context.safetensors that was trained on them: make it by scripts/train context --weights, or set "
                "extract.context=false"
            )

    def own_weights(self) -> tuple[str, ...]:
        """Those in the folder that this recipe reads."""
        return tuple(str(self._path(name)) for name in self._own_names())

    def _own_names(self) -> list[str]:
        return [name for name in self._asked() if self._own(name) is not None]

    def _asked(self) -> list[str]:
        """Names of the networks that this recipe needs, in order."""
        needed = {
            "context": self.context,
            "detector": self.detector == "network",
            "geodesc": True,
            "orientation": self.orientation in ("auto", "network"),
        }
        return [name for name, asked in needed.items() if asked]

    def _path(self, name: str) -> Path:
        from aeromatch_cli.nets.files import shipped_path

        return self._own(name) or shipped_path(name)

    def _own(self, name: str) -> Path | None:
        """The user's file of a network, where there is one."""
        path = None if self.weights is None else Path(self.weights).expanduser() / f"{name}.safetensors"
        return path if path is not None and path.is_file() else None

    def _network(self, name: str) -> Any:
        """Once per process."""
        from aeromatch_cli.nets.context import load_context
        from aeromatch_cli.nets.detector import load_detector
        from aeromatch_cli.nets.geodesc import load_geodesc
        from aeromatch_cli.nets.orientation import load_orientation

        path, device = self._path(name), device_of(self.device)
        if name == "context":
            return load_context(path, device)
        loaders = {"detector": load_detector, "geodesc": load_geodesc, "orientation": load_orientation}
        return loaders[name](path, precision=self.precision, device=device)

    def detected(self, view: ViewPixels, view_idx: int) -> Raw:
        """One feature for each point, not yet turned; of SIFT's with `gradient` one for each of its orientations."""
        if self.detector == "sift":
            raw = detect(sift_detector(), view, view_idx)
            return raw if self._angles_of_sift else raw.upright()
        most = _CHOICE * self.keypoints
        points, sizes, confidences = heat_keypoints(view.gray, most, view.valid, self._network("detector"))
        return Raw.of_points(points, sizes, confidences, view_idx)

    def suffice(self, raw: Raw, factor: int) -> bool:
        """The network's always: the surest of finer views are finer ones, which match none of the other images."""
        return self.detector == "network" or super().suffice(raw, factor)

    def strengths(self, raw: Raw) -> FloatArray:
        """The network's confidence; of SIFT's keypoints what `sift` chooses by."""
        return balanced(raw) if self.detector == "sift" else raw.responses

    def turned(self, raw: Raw, views: Sequence[ViewPixels]) -> Raw:
        """Orientations by the network or by gradients, where a view needs them."""
        if self._angles_of_sift:
            return raw
        angles = raw.orientations_deg.copy()
        for view_idx, view in enumerate(views):
            of_view = np.flatnonzero(raw.view_idx == view_idx)
            upright = self.orientation == "upright" or (self.orientation == "auto" and view.view.north_up)
            if len(of_view) and not upright:
                angles[of_view] = self._angles(_patches(view, raw.take(of_view)))
        return replace(raw, orientations_deg=angles)

    @property
    def _angles_of_sift(self) -> bool:
        """Whether keypoints come with orientations."""
        return self.detector == "sift" and self.orientation == "gradient"

    def _angles(self, patches: NDArray[np.uint8]) -> FloatArray:
        """Degrees (N,), x towards y, of the direction that patches (N, 32, 32) are to be cut along."""
        if self.orientation == "gradient":
            return gradient_angles(patches)
        from aeromatch_cli.nets.orientation import directions

        cosine, sine = directions(patches, self._network("orientation")).T
        return np.asarray(np.rad2deg(np.arctan2(sine, cosine)))

    def described(self, raw: Raw, views: Sequence[ViewPixels]) -> NDArray[np.uint8]:
        """Descriptor bytes (N, 128), see `as_bytes`."""
        from aeromatch_cli.nets.geodesc import describe

        found = np.zeros((len(raw.view_idx), self.descriptor_length), np.float32)
        for view_idx, view in enumerate(views):
            of_view = np.flatnonzero(raw.view_idx == view_idx)
            if len(of_view):
                there = raw.take(of_view)
                plain = describe(_patches(view, there), self._network("geodesc"))
                if self.context:
                    plain = with_context(plain, there, view.gray, self._network("context"), self.precision)
                found[of_view] = plain
        return as_bytes(found)


def _patches(view: ViewPixels, raw: Raw) -> NDArray[np.uint8]:
    """(N, 32, 32) around the features."""
    levels = levels_of(view.gray)
    return cut_patches(levels, raw.points_px.astype(np.float64), raw.sizes_px, raw.orientations_deg)
