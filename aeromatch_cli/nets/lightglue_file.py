"""LightGlue's weights files: every key style, the file's own dimensions, loaded strictly."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.files import read_tensors
from aeromatch_cli.nets.lightglue import Dimensions, LightGlue
from aeromatch_cli.nets.loading import check_same_tensors

# kornia's constructor makes it from the number of layers, so a file may have it or leave it out.
_DERIVED = frozenset({"confidence_thresholds"})
_OLD_LAYER_KEY = re.compile(r"^(self|cross)_attn\.(\d+)\.")
_LAYER_KEY = re.compile(r"^transformers\.(\d+)\.")
_POSITION_KEY, _GROUND_KEY = "posenc.Wr.weight", "groundenc.Wr.weight"
_WIDTH_KEY = "transformers.0.self_attn.out_proj.weight"
_PROJECTION_KEY = "input_proj.weight"
# Entries of a safetensors file's metadata: slope and offset, separated by a space; the descriptors that it was trained
# on, as extractors name theirs ("RootSIFT", "GeoDesc").
CALIBRATION_KEY, DESCRIPTORS_KEY = "calibration", "descriptors"


@dataclass(frozen=True)
class Calibration:
    """What makes a network's scores the share of matches that are right: log odds = slope * log odds + offset.

    Source: Platt, Probabilistic outputs for support vector machines, 1999. Without one, scores stay as they are.
    """

    slope: float = 1.0
    offset: float = 0.0

    def calibrated(self, scores: FloatArray) -> FloatArray:
        """Scores (N,) in 0-1 of the network as probabilities (N,)."""
        if self == Calibration():
            return np.asarray(scores, np.float64)
        bounded = np.clip(np.asarray(scores, np.float64), 1e-9, 1.0 - 1e-9)
        return np.asarray(1.0 / (1.0 + np.exp(-(self.slope * np.log(bounded / (1.0 - bounded)) + self.offset))))

    def score_of(self, probability: float) -> float:
        """The network's score that means this probability; 0 and 1 stay."""
        if self == Calibration() or not 0.0 < probability < 1.0:
            return probability
        return 1.0 / (1.0 + math.exp((self.offset - math.log(probability / (1.0 - probability))) / self.slope))


def read_calibration(path: Path) -> Calibration:
    """Of a weights file; the neutral one where it has none. Raises ConfigError where what it has is no calibration."""
    text = _metadata(path).get(CALIBRATION_KEY)
    if text is None:
        return Calibration()
    try:
        slope, offset = (float(part) for part in text.split())
    except ValueError:
        slope = offset = math.nan
    if not (slope > 0.0 and math.isfinite(slope + offset)):
        raise ConfigError(f"weights file {path}: calibration {text!r} is no positive slope and an offset")
    return Calibration(slope, offset)


def read_descriptors(path: Path) -> str:
    """Which descriptors a weights file was trained on, "" where it does not say."""
    return _metadata(path).get(DESCRIPTORS_KEY, "")


def _metadata(path: Path) -> dict[str, str]:
    """What a weights file says beside its tensors. Raises ConfigError where it cannot be read."""
    from safetensors import SafetensorError, safe_open

    if path.suffix != ".safetensors":
        return {}
    try:
        with safe_open(path, framework="np") as content:
            return content.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise ConfigError(f"weights file {path}: what it says of itself cannot be read ({error})") from error


def canonical_keys(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors under kornia's names: without the prefix `matcher.`, and with the first releases' `self_attn.N.` and
    `cross_attn.N.` as `transformers.N.self_attn.` and `transformers.N.cross_attn.`.

    Raises ValueError where two names of the file mean the same tensor.
    """
    renamed: dict[str, Tensor] = {}
    for key, value in tensors.items():
        name = _OLD_LAYER_KEY.sub(r"transformers.\2.\1_attn.", key.removeprefix("matcher."))
        if name in renamed:
            raise ValueError(f"{key} is given twice")
        renamed[name] = value
    return renamed


def infer_dimensions(tensors: dict[str, Tensor]) -> Dimensions:
    """Dimensions from the shapes of canonical tensors. Raises ValueError where they are not a LightGlue's."""
    missing = [key for key in (_POSITION_KEY, _WIDTH_KEY) if key not in tensors]
    if missing:
        raise ValueError(f"it has no {' and no '.join(missing)}")
    for key in (_POSITION_KEY, _WIDTH_KEY, _PROJECTION_KEY):
        if key in tensors and (tensors[key].ndim != 2 or not tensors[key].numel()):
            raise ValueError(f"{key} of shape {tuple(tensors[key].shape)} is no matrix")
    descriptor_dim = int(tensors[_WIDTH_KEY].shape[0])
    half_head_dim, position_dim = (int(size) for size in tensors[_POSITION_KEY].shape)
    if position_dim not in (2, 4):
        raise ValueError(f"its keypoints have {position_dim} coordinates; only 2 or 4 (with scale, orientation) work")
    num_heads, rest = divmod(descriptor_dim, 2 * half_head_dim)
    if rest or num_heads == 0:
        raise ValueError(f"{_POSITION_KEY} and {_WIDTH_KEY} disagree")
    projection = tensors.get(_PROJECTION_KEY)
    layers = {int(match.group(1)) for key in tensors if (match := _LAYER_KEY.match(key))}
    return Dimensions(
        input_dim=descriptor_dim if projection is None else int(projection.shape[-1]),
        descriptor_dim=descriptor_dim,
        n_layers=len(layers),
        num_heads=num_heads,
        add_scale_ori=position_dim == 4,
        knows_ground=_GROUND_KEY in tensors,
    )


def load_lightglue(path: Path, *, device: str = "cpu") -> LightGlue:
    """The network of a weights file in float32, in evaluation mode, without gradients.

    Every tensor of the network comes from the file and every tensor of the file goes into the network; only the
    derived buffer `confidence_thresholds` may be there or not. Raises ConfigError otherwise.
    """
    source = read_tensors(path)
    try:
        tensors = canonical_keys(source)
        with torch.random.fork_rng(devices=[]):
            network = LightGlue(infer_dimensions(tensors))
        check_same_tensors(network.state_dict(), tensors, _DERIVED)
    except ValueError as error:
        raise ConfigError(f"weights file {path} does not fit LightGlue: {error}") from error
    network.load_state_dict({key: tensors[key] for key in network.state_dict()}, strict=True)
    return network.to(device=device, dtype=torch.float32).eval().requires_grad_(False)
