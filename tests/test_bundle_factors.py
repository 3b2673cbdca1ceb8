"""Cholesky factors of sparse matrices by nested dissection: against numpy's full solution and inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from aeromatch_cli.data import FloatArray
from aeromatch_cli.sfm.bundle.factors import Factors


def coupled(places: FloatArray, last: int, reach: float, seed: int) -> FloatArray:
    """A positive definite matrix in blocks of six: those at `places` couple within `reach`, the last ones with all."""
    rng = np.random.default_rng(seed)
    count = len(places) + last
    near = np.linalg.norm(places[:, None] - places, axis=2) < reach
    rows = [rng.normal(size=(12, 6 * count)) * 1e-3 ** rng.random(6 * count) for _ in range(len(places))]
    for image, row in enumerate(rows):
        seen = np.concatenate([near[image], np.ones(last, bool)])
        row *= np.repeat(seen, 6)
    normals = np.concatenate(rows)
    matrix = normals.T @ normals
    return np.asarray(matrix + np.diag(0.1 * np.diag(matrix)))


def close(found: FloatArray, expected: FloatArray, by: FloatArray) -> None:
    """Equal, in units of what each row and column is known to."""
    np.testing.assert_allclose(found / by, expected / by, atol=1e-7)


@given(st.integers(0, 2**31), st.integers(1, 14), st.integers(0, 3), st.floats(0.5, 4.0))
@settings(max_examples=15, deadline=None)
def test_solution_and_inverse_are_numpys(seed: int, side: int, last: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((side, 9))) + rng.normal(0.0, 0.1, (9 * side, 2))
    matrix = coupled(places, last, reach, seed)
    factors = Factors(sparse.csr_matrix(matrix), places, rng.permutation(len(places))[: side % 4])
    inverse = np.linalg.inv(matrix)
    sigmas = np.sqrt(np.diag(inverse))
    right = rng.normal(size=(len(matrix), 2)) / sigmas[:, None]
    close(factors.solve(right), inverse @ right, sigmas[:, None])
    images, rest = factors.inverse_blocks(len(places))
    assert images.shape == (len(places), 6, 6)
    first = 6 * len(places)
    close(rest, inverse[first:, first:], np.outer(sigmas[first:], sigmas[first:]))
    for image, block in enumerate(images):
        own = slice(6 * image, 6 * image + 6)
        close(block, inverse[own, own], np.outer(sigmas[own], sigmas[own]))


def test_an_image_without_observations_changes_no_other() -> None:
    places = np.argwhere(np.ones((10, 10))).astype(float)
    matrix = coupled(places, 1, 2.0, 0)
    unseen = slice(6 * 37, 6 * 38)
    matrix[unseen] = matrix[:, unseen] = 0.0
    others = np.delete(np.arange(len(matrix)), np.arange(unseen.start, unseen.stop))
    expected = np.linalg.inv(matrix[np.ix_(others, others)])
    sigmas = np.sqrt(np.diag(expected))
    images, _ = Factors(sparse.csr_matrix(matrix), places).inverse_blocks(100)
    found = np.delete(np.diagonal(images, axis1=1, axis2=2), 37, axis=0).ravel()
    np.testing.assert_allclose(np.sqrt(found), sigmas[: len(found)], rtol=1e-8)


def test_a_matrix_that_is_far_from_positive_definite_is_refused() -> None:
    matrix = coupled(np.argwhere(np.ones((3, 3))).astype(float), 0, 9.0, 0)
    matrix[0, 1] = matrix[1, 0] = 2.0 * np.sqrt(matrix[0, 0] * matrix[1, 1])
    with pytest.raises(np.linalg.LinAlgError):
        Factors(sparse.csr_matrix(matrix), np.zeros((9, 2)))
