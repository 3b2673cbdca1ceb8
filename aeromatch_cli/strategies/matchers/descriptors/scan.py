"""The score matrix of two sets of descriptors, block by block, exact to the bit on any machine.

RootSIFT descriptors are bytes, so every dot product is an integer that 32 bits hold exactly: an 8-bit integer product
(where the processor has one) and float32 BLAS (sums below 2^24) give the same numbers whatever the library does. Only a
place within rounding of a window's border may count as inside on one machine and as outside on another.
Source: Lowe, IJCV 2004, section 7.1 (ratio); Arandjelovic and Zisserman, CVPR 2012 (RootSIFT).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray

# Rows of the score matrix at a time: 128 x 4000 values stay in a core's own cache for all passes over them.
_BLOCK_ROWS = 128
_SHIFT = 128
# So many products of descriptors, made or expected, are worth loading torch for integer ones: in floating point they
# take two or three times as long as loading it (1.7 s), in integers a third of that (8,000 descriptors an image, one
# core with VNNI: 0.08 s a pair instead of 0.26).
_LOADING_PAYS = 1_000_000_000
_COMPONENTS_EXACT = 128  # 2 x 128 x 255^2 < 2^24: up to here float32 sums of byte products are exact

Multiply = Callable[[int, int, NDArray[Any]], NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Limits:
    """Which targets a query may take. forms: (Q, 2, 3) linear forms; places: (T, 2): both |form . (x, y, 1)| <= 1.

    turned: whether queries and targets are the other way round: places (Q, 2), forms (T, 2, 3).
    """

    forms: FloatArray
    places: FloatArray
    turned: bool = False

    def seen_from(self, which: IntArray) -> Limits:
        """Which queries each of the targets (N,) may take: those that may take it."""
        return Limits(self.forms, self.places[which], turned=True)

    def factors(self) -> list[tuple[NDArray[Any], NDArray[Any]]]:
        """Matrices (Q, 3), (3, T) of either form, whose product must not leave -1 to 1."""
        places = np.column_stack([self.places, np.ones(len(self.places))]).astype(np.float32)
        forms = [np.ascontiguousarray(self.forms[:, k], np.float32) for k in range(2)]
        return [(places, form.T) if self.turned else (form, places.T) for form in forms]


def mutual_nearest(
    descriptors0: NDArray[Any],
    descriptors1: NDArray[Any],
    keypoint_idx1: IntArray,
    *,
    ratio: float,
    limits: Limits | None = None,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Descriptor rows, columns (int64) and ratios d1/d2 (float64) of mutual nearest neighbours that pass the ratio.

    descriptors (D0, C), (D1, C): both uint8 or both float32. The runner-up d2 belongs to another keypoint than the
    nearest; without one the ratio is 0. On equal distances the lower index wins.
    """
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    nearest, best, second, column_best = _scan(descriptors0, descriptors1, keypoint_idx1, limits)
    ratios = _ratios(best, second)
    found = best > _lowest(best.dtype)
    rows = np.flatnonzero(found & (best == column_best[nearest]) & (ratios < ratio))
    # Two rows may be equally near to one column: the first keeps it.
    _, first = np.unique(nearest[rows], return_index=True)
    rows = rows[np.sort(first)]
    return rows, nearest[rows], ratios[rows]


def ratios_of(
    queries: NDArray[Any], targets: NDArray[Any], target_keypoint_idx: IntArray, *, limits: Limits | None = None
) -> FloatArray:
    """Ratio d1/d2 (Q,) of each query (Q, C) among targets (T, C), as in `mutual_nearest`."""
    if len(queries) == 0 or len(targets) == 0:
        return np.zeros(len(queries))
    _, best, second, _ = _scan(queries, targets, target_keypoint_idx, limits)
    return _ratios(best, second)


def _ratios(best: NDArray[Any], second: NDArray[Any]) -> FloatArray:
    """d1/d2 (float64) of negated squared distances; 0 where there is no second, 1 where both are 0."""
    near, far = np.maximum(-best.astype(np.float64), 0.0), np.maximum(-second.astype(np.float64), 0.0)
    ratio = np.sqrt(np.divide(near, far, out=np.ones_like(near), where=(far > 0) & np.isfinite(near)))
    ratio[second == _lowest(second.dtype)] = 0.0
    return ratio


def _lowest(dtype: np.dtype[Any]) -> Any:
    return np.iinfo(dtype).min if np.issubdtype(dtype, np.integer) else -np.inf


def _scan(
    queries: NDArray[Any], targets: NDArray[Any], target_keypoint_idx: IntArray, limits: Limits | None = None
) -> tuple[IntArray, NDArray[Any], NDArray[Any], NDArray[Any]]:
    """One pass over the score matrix s = -|q - t|^2, block by block.

    Returns the nearest target of each query (Q,), its score, the best score of another keypoint (Q,) and the best
    score of each target (T,).
    """
    multiply, norms_q, norms_t, dtype = _product(queries, targets)
    # Descriptors of one keypoint side by side, so that the nearest one's siblings are a short run of columns.
    run_start, run_length = _runs(target_keypoint_idx)
    outside = None if limits is None else _outside(limits)
    nearest = np.empty(len(queries), np.int64)
    best: NDArray[Any] = np.empty(len(queries), dtype)
    second: NDArray[Any] = np.empty(len(queries), dtype)
    column_best: NDArray[Any] = np.full(len(targets), _lowest(np.dtype(dtype)), dtype)
    for start in range(0, len(queries), _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, len(queries))
        scores = multiply(start, stop, norms_t)
        scores -= norms_q[start:stop, None]
        if outside is not None:
            np.copyto(scores, _lowest(scores.dtype), where=outside(start, stop))
        rows = np.arange(stop - start)
        at = scores.argmax(axis=1)
        nearest[start:stop], best[start:stop] = at, scores[rows, at]
        np.maximum(column_best, scores.max(axis=0), out=column_best)
        for k in range(int(run_length[at].max())):
            scores[rows, run_start[at] + np.minimum(k, run_length[at] - 1)] = _lowest(scores.dtype)
        second[start:stop] = scores.max(axis=1)
    return nearest, best, second, column_best


def _outside(limits: Limits) -> Callable[[int, int], BoolArray]:
    """Which targets (rows, T) the queries of a block must not take; what is not finite fits nowhere."""
    factors = limits.factors()
    shape = (min(_BLOCK_ROWS, len(factors[0][0])), factors[0][1].shape[1])
    value, flags, other = np.empty(shape, np.float32), np.empty(shape, bool), np.empty(shape, bool)

    def outside(start: int, stop: int) -> BoolArray:
        values, mask, second = value[: stop - start], flags[: stop - start], other[: stop - start]
        for (of_queries, of_targets), answer in zip(factors, (mask, second), strict=True):
            with np.errstate(invalid="ignore", over="ignore"):
                np.matmul(of_queries[start:stop], of_targets, out=values)
            np.abs(values, out=values)
            np.less_equal(values, 1.0, out=answer)
        np.logical_and(mask, second, out=mask)
        return np.logical_not(mask, out=mask)

    return outside


def _runs(keypoint_idx: IntArray) -> tuple[IntArray, IntArray]:
    """Start and length, per descriptor, of the run of equal keypoint numbers it lies in (extractors write runs)."""
    starts = np.flatnonzero(np.concatenate([[True], keypoint_idx[1:] != keypoint_idx[:-1]]))
    lengths = np.diff(np.append(starts, len(keypoint_idx)))
    return np.repeat(starts, lengths), np.repeat(lengths, lengths)


def _product(queries: NDArray[Any], targets: NDArray[Any]) -> tuple[Multiply, NDArray[Any], NDArray[Any], type]:
    """How to compute 2 q.t - |t|^2 for a block of queries, with the squared norms and the type of the result."""
    are_bytes = queries.dtype == np.uint8 and targets.dtype == np.uint8 and queries.shape[1] <= _COMPONENTS_EXACT
    if are_bytes and _worth_torch(len(queries) * len(targets)) and _has_integer_product():
        return _integer_product(queries, targets)
    q, t = queries.astype(np.float32), targets.astype(np.float32)
    transposed = t.T
    buffer = np.empty((min(_BLOCK_ROWS, len(q)), len(t)), np.float32)

    def multiply(start: int, stop: int, norms: NDArray[Any]) -> NDArray[Any]:
        block = buffer[: stop - start]
        np.matmul(q[start:stop], transposed, out=block)
        block += block
        block -= norms
        return block

    return multiply, (q * q).sum(axis=1), (t * t).sum(axis=1), np.float32


def _integer_product(queries: NDArray[Any], targets: NDArray[Any]) -> tuple[Multiply, NDArray[Any], NDArray[Any], type]:
    """The same on signed bytes: distances do not change when both sides are shifted by 128."""
    import torch

    q, t = ((x.astype(np.int16) - _SHIFT).astype(np.int8) for x in (queries, targets))
    q_torch, t_torch = torch.from_numpy(q), torch.from_numpy(t).T
    buffer_torch = torch.empty((min(_BLOCK_ROWS, len(q)), len(t)), dtype=torch.int32)
    buffer = buffer_torch.numpy()

    def multiply(start: int, stop: int, norms: NDArray[Any]) -> NDArray[Any]:
        torch._int_mm(q_torch[start:stop], t_torch, out=buffer_torch[: stop - start])
        block: NDArray[Any] = buffer[: stop - start]
        block += block
        block -= norms
        return block

    norms = [np.einsum("ij,ij->i", x, x, dtype=np.int32) for x in (q, t)]
    return multiply, norms[0], norms[1], np.int32


@dataclass
class _Work:
    """products: of descriptors that this process has made so far. comparisons: pairs that it is expected to compare."""

    products: int = 0
    comparisons: int = 0


_WORK = _Work()


def expect_comparisons(count: int) -> None:
    """Say how many pairs this process is likely to compare."""
    _WORK.comparisons = count


def _worth_torch(products: int) -> bool:
    """Whether torch is loaded, or there are so many products that it is worth loading. Floating point is as exact."""
    _WORK.products += products
    most = max(_WORK.products, products * _WORK.comparisons)
    return "torch" in sys.modules or (most > _LOADING_PAYS and _may_multiply_bytes())


@cache
def _may_multiply_bytes() -> bool:
    """Whether the processor says that it multiplies bytes; only Linux tells without torch."""
    path = Path("/proc/cpuinfo")
    return path.is_file() and "vnni" in path.read_text(encoding="utf-8", errors="replace")


@cache
def _has_integer_product() -> bool:
    """Whether this processor multiplies bytes fast, and does so without saturating: tried once on extreme values.

    A product of two bytes fills 16 bits, so where instructions without VNNI add neighbours in 16 bits, runs of equal
    extremes saturate and alternating ones do not: rows of both kinds are tried.
    """
    import torch

    supported = getattr(torch.cpu, "_is_vnni_supported", None)
    if supported is None or not supported() or not hasattr(torch, "_int_mm"):
        return False
    period = np.arange(1, 33)[:, None]
    extremes = np.where(np.arange(128) // period % 2 == 0, 127, -128).astype(np.int8)
    product = torch._int_mm(torch.from_numpy(extremes), torch.from_numpy(extremes).T).numpy()
    wide = extremes.astype(np.int64)
    return bool(np.array_equal(product, wide @ wide.T))
