"""How equal the answers of two runtimes are, and the table of them."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import runtimes


def test_maxima_within_a_pixel_are_equal() -> None:
    heat = np.random.default_rng(0).random((1, 1, 200, 200)).astype(np.float32)
    moved = np.roll(heat, 1, axis=3)
    far = np.roll(heat, 40, axis=2)
    assert runtimes._equal_maxima((heat,), (heat,)) == 1.0
    assert runtimes._equal_maxima((moved,), (heat,)) > 0.95
    assert runtimes._equal_maxima((far,), (heat,)) < 0.5


def test_vectors_are_equal_by_their_cosine() -> None:
    turned = np.deg2rad([0.0, 4.0, 6.0])
    answer = np.column_stack([np.cos(turned), np.sin(turned)]).astype(np.float32)
    right = np.tile(np.array([1.0, 0.0], np.float32), (3, 1))
    assert runtimes._share((answer,), (right,), np.cos(np.deg2rad(5.0))) == pytest.approx(2 / 3)


def test_pairs_are_equal_where_both_are_each_others_best() -> None:
    right = np.array([[9, 1, 0], [0, 8, 1], [0, 1, 7]], np.float32)
    other = np.array([[9, 1, 0], [0, 1, 8], [0, 7, 1]], np.float32)
    assert runtimes._equal_pairs((right,), (right,)) == 1.0
    assert runtimes._equal_pairs((other,), (right,)) == pytest.approx(1 / 3)


def test_the_table_compares_with_pytorch() -> None:
    rows = [
        {"network": "GeoDesc", "runtime": "torch", "threads": 1, "ms": 20.0, "equal": 1.0},
        {"network": "GeoDesc", "runtime": "openvino", "threads": 1, "ms": 15.0, "equal": 0.995},
    ]
    assert "| GeoDesc | 1 | `openvino` | 15.0 | 0.75 x | 99.5 % |" in runtimes.table_of(rows)
