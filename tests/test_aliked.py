"""ALIKED's network beside kornia's, with the same random weights."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets import aliked
from aeromatch_cli.nets.aliked import AlikedNetwork

MOST = 60


@pytest.fixture(scope="module")
def theirs() -> Any:
    """Random weights, and statistics of batches that are not those of an untrained network."""
    from kornia.feature import ALIKED

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        network = ALIKED("aliked-n16", max_num_keypoints=MOST, detection_threshold=0.0).eval()
        for name, tensor in network.state_dict().items():
            if name.endswith(("running_mean", "running_var", "bias")):
                tensor.copy_(0.5 + 0.4 * torch.rand_like(tensor))
    return network


def picture(width: int, height: int) -> torch.Tensor:
    noise = np.random.default_rng(2).random((height, width, 3)).astype(np.float32)
    return torch.from_numpy(cv2.GaussianBlur(noise, (0, 0), 1.5)).permute(2, 0, 1)


@pytest.mark.parametrize("size", [(133, 150), (64, 96)])
def test_numbers_are_kornias(theirs: Any, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]) -> None:
    """In pieces, too, and where the picture is filled up on all sides."""
    monkeypatch.setattr(aliked, "PIECE_PX", 40)
    colour = picture(*size)
    own = AlikedNetwork(theirs.state_dict())
    maps = own.maps(colour)
    with torch.inference_mode():
        _, scores = theirs.extract_dense_map(colour[None])
        (known,) = theirs(colour[None])
    torch.testing.assert_close(maps.scores, scores[0, 0], rtol=0.0, atol=1e-4)
    points, responses = own.keypoints(maps, MOST)
    assert len(points) == len(known.keypoints) == MOST
    far_px, nearest = cKDTree(known.keypoints.numpy()).query(points.numpy())
    assert far_px.max() < 0.02
    torch.testing.assert_close(responses, known.keypoint_scores[nearest], rtol=0.0, atol=1e-4)
    torch.testing.assert_close(own.descriptors(maps, known.keypoints), known.descriptors, rtol=0.0, atol=1e-3)


def test_other_weights_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"no weights of ALIKED: block1\.bn1\.weight is missing"):
        AlikedNetwork({})
