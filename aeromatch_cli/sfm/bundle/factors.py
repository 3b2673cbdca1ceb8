"""Cholesky factors of a large sparse matrix, solutions with them, and blocks of its inverse.

Blocks that couple with few others are divided again and again by those that separate two halves from each other (nested
dissection: George 1973). Every part is eliminated as a full matrix of its own blocks and of those on its border (Duff
and Reid 1983). The inverse's blocks of a part then follow from those of its border (Takahashi, Fagan and Chen 1973), so
that the inverse, which is full, is never made.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

if TYPE_CHECKING:
    from scipy import sparse

# Unknowns of a block.
_SIZE = 6
# Up to so many blocks are eliminated together: full matrices of this size take less time than their division.
_MOST_BLOCKS = 60
_NONE = np.zeros(0, int)
# What is added to the diagonal, which is 1, of a part that is not positive definite, at first and at most.
_LEAST_ADDED, _MOST_ADDED = 1e-12, 1e-2


@dataclass(eq=False)
class _Part:
    """own: unknowns (n,) that are eliminated; border: those (m,) of later parts that these couple with. root: (n, n),
    lower, of the own matrix A = root root'; coupled: (n, m) of inv(root) by what couples with the border.
    """

    own: IntArray
    border: IntArray
    parts: list[_Part] = field(default_factory=list)
    root: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    coupled: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def unknowns(self) -> IntArray:
        return np.concatenate([self.own, self.border])


class Factors:
    """Holds the factors of a symmetric, positive definite matrix (6 B, 6 B) whose rows may have any units.

    places: (B', 2) of the first B' blocks in the plane, those that are divided; blocks that come after them, and those
    in `together` (T,), may couple with all others. A matrix that is far from positive definite raises LinAlgError.
    """

    def __init__(self, matrix: sparse.csr_matrix, places: FloatArray, together: IntArray = _NONE) -> None:
        from scipy import sparse

        diagonal = matrix.diagonal()
        self._scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        unknown = sparse.diags(np.where(diagonal > 0.0, 0.0, 1.0))
        scaled = (sparse.diags(self._scale) @ matrix @ sparse.diags(self._scale) + unknown).tocsr()
        blocks = scaled.tobsr((_SIZE, _SIZE))
        graph = sparse.csr_matrix((np.ones(len(blocks.indices), bool), blocks.indices, blocks.indptr))
        last = np.union1d(together, np.arange(len(places), graph.shape[0]))
        first = np.setdiff1d(np.arange(len(places)), last)
        self._last = _Part(_unknowns(last), _NONE, _divided(graph, places, first) if len(first) else [])
        self._order = list(_in_order(self._last))
        _eliminate(scaled, self._order)

    def solve(self, right: FloatArray) -> FloatArray:
        """(6 B, K) the inverse times `right` (6 B, K)."""
        from scipy import linalg

        values = self._scale[:, None] * right
        for part in self._order:
            values[part.own] = linalg.solve_triangular(part.root, values[part.own], lower=True, check_finite=False)
            values[part.border] -= part.coupled.T @ values[part.own]
        for part in reversed(self._order):
            rest = values[part.own] - part.coupled @ values[part.border]
            values[part.own] = linalg.solve_triangular(part.root, rest, lower=True, trans=1, check_finite=False)
        return np.asarray(self._scale[:, None] * values)

    def inverse_blocks(self, first: int) -> tuple[FloatArray, FloatArray]:
        """(B', 6, 6) blocks of the inverse on the diagonal before block `first`, and (r, r) all that follow them."""
        from scipy import linalg

        found = np.zeros((len(self._scale) // _SIZE, _SIZE, _SIZE))
        by_part: dict[int, FloatArray] = {id(self._last): np.zeros((0, 0))}
        rest = np.zeros((0, 0))
        place = np.zeros(len(self._scale), int)
        for part in reversed(self._order):
            border = by_part.pop(id(part))
            by_border = linalg.solve_triangular(part.root, part.coupled, lower=True, trans=1, check_finite=False)
            between = -by_border @ border
            own = linalg.lapack.dpotri(part.root, lower=1)[0] if len(part.root) else part.root
            own = np.tril(own) + np.tril(own, -1).T - between @ by_border.T
            whole = np.block([[own, between], [between.T, border]])
            numbers = part.own[::_SIZE] // _SIZE
            blocks = [own[k : k + _SIZE, k : k + _SIZE] for k in range(0, len(own), _SIZE)]
            found[numbers] = np.array(blocks).reshape(-1, _SIZE, _SIZE)
            place[part.unknowns] = np.arange(len(whole))
            for inner in part.parts:
                by_part[id(inner)] = whole[np.ix_(place[inner.border], place[inner.border])]
            if part is self._last:
                rows = np.searchsorted(part.own, np.arange(_SIZE * first, len(self._scale)))
                rest = own[np.ix_(rows, rows)]
        scale = self._scale.reshape(-1, _SIZE)
        found *= scale[:, :, None] * scale[:, None, :]
        last = self._scale[_SIZE * first :]
        return found[:first], rest * np.outer(last, last)


def _unknowns(blocks: IntArray) -> IntArray:
    return np.asarray((_SIZE * blocks[:, None] + np.arange(_SIZE)).ravel())


def _divided(graph: sparse.csr_matrix, places: FloatArray, members: IntArray) -> list[_Part]:
    """The part that eliminates these blocks, those before it in it."""
    beside = np.zeros(graph.shape[0], bool)
    beside[graph[members].indices] = True
    beside[members] = False
    border = _unknowns(np.flatnonzero(beside))
    if len(members) <= _MOST_BLOCKS:
        return [_Part(_unknowns(members), border)]
    axis = np.ptp(places[members], axis=0).argmax()
    order = members[np.argsort(places[members, axis], kind="stable")]
    one, other = np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :])
    between = np.diff(graph[one][:, other].indptr) > 0
    inner = [part for side in (one[~between], other) if len(side) for part in _divided(graph, places, side)]
    return [_Part(_unknowns(one[between]), border, inner)] if between.any() else inner


def _in_order(part: _Part) -> Iterator[_Part]:
    """Yield all parts, those that are eliminated before others first."""
    for inner in part.parts:
        yield from _in_order(inner)
    yield part


def _eliminate(matrix: sparse.csr_matrix, order: list[_Part]) -> None:
    from scipy import linalg

    left: dict[int, FloatArray] = {}
    place = np.zeros(matrix.shape[0], int)
    for part in order:
        unknowns, own = part.unknowns, len(part.own)
        place[unknowns] = np.arange(len(unknowns))
        full = np.zeros((len(unknowns), len(unknowns)))
        full[:own] = matrix[part.own][:, unknowns].toarray()
        for inner in part.parts:
            rows = place[inner.border]
            full[np.ix_(rows, rows)] -= left.pop(id(inner))
        part.root = _root(full[:own, :own])
        part.coupled = linalg.solve_triangular(part.root, full[:own, own:], lower=True, check_finite=False)
        left[id(part)] = part.coupled.T @ part.coupled - full[own:, own:]


def _root(matrix: FloatArray) -> FloatArray:
    """The lower Cholesky factor; of a matrix that is not positive definite, such as of an image that its points do not
    determine, of the nearest that is."""
    from scipy import linalg

    added = 0.0
    while True:
        try:
            return np.asarray(linalg.cholesky(matrix + added * np.eye(len(matrix)), lower=True, check_finite=False))
        except linalg.LinAlgError:
            if added > _MOST_ADDED:
                raise
            added = max(10.0 * added, _LEAST_ADDED)
