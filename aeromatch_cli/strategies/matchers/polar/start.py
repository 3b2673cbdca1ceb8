"""Where to start: correlation of small pictures over all shifts, for every turn and scale that is possible.

Fourier-Mellin looks at magnitude spectra, which show both pictures whole; where they share a third, two thirds of
either spectrum are noise. Trying 46 turns and 5 scales of pictures 48 px long costs as much as a few dozen small
transforms, and each compares the shared part alone. Half of the turns are free: a turn by 180 degrees more is the
conjugate spectrum.

Both pictures are whitened beforehand: every frequency counts alike. Ploughed rows have nearly all their contrast in a
few, and fit as well anywhere along the rows; what is left when these count no more than others says where. (Of eight
pairs of one such block, overlap 0.35 to 0.7, the right place was the best of all for every one; for five without.)

Source: normalised correlation of masked pictures by FFT, Padfield, IEEE TIP 21(5), 2012, here of pictures that are
normalised locally beforehand, so that a sum over the overlap needs to be divided by the root of its area only; phase
correlation of both spectra, Chen, Defrise and Deconinck, IEEE TPAMI 16(12), 1994, here over smoothed spectra.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.strategies.matchers.polar.level import normalised

# Of the smaller picture. Where anything is possible less is a lottery; 0.3 may look like this by the similarity's own
# inexactness. Where a prior leaves little choice, half of it is enough.
_LEAST_OVERLAP, LEAST_EXPECTED_OVERLAP = 0.22, 0.1
_SPREAD = 12.0  # pictures are normalised over the longer side by this
_SAME_PX, _SAME_RAD = 3.0, np.deg2rad(12.0)
# Whitening: a spectrum is divided by itself, smoothed by so many of its samples; what holds less than this share of the
# mean is not raised; frequencies beyond about so many cycles per pixel fade.
_SMOOTH, _FAINT, _FINEST = 2.0, 0.03, 0.22


@dataclass(frozen=True, eq=False)
class Candidate:
    """score: correlation over the overlap, in standard deviations of all shifts. matrix: (3, 3) px1 from px0."""

    score: float
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class Search:
    """turns_rad: (T,) and scales: (S,) to try, px1 per px0. opposites: also every turn and 180 degrees more.
    expected: (3, 3) px1 from px0, of small pictures, and reach_px: how far off it may be at the middle, or None.
    least_overlap: of the smaller picture.
    """

    turns_rad: FloatArray
    scales: FloatArray
    opposites: bool
    expected: FloatArray | None = None
    reach_px: float = np.inf
    least_overlap: float = _LEAST_OVERLAP


def everywhere(turn_step_deg: float, scale_count: int, smallest: float, largest: float) -> Search:
    """Any turn, scales evenly by their logarithm."""
    turns = np.deg2rad(np.arange(0.0, 180.0, turn_step_deg))
    return Search(turns, np.geomspace(smallest, largest, scale_count), opposites=True)


def candidates(
    pictures: tuple[FloatArray, FloatArray], valid: tuple[BoolArray | None, BoolArray | None], search: Search
) -> list[Candidate]:
    """The best shift of every turn and scale, best first, each that lies apart from the better ones."""
    ones = [
        np.ones(picture.shape, np.float32) if mask is None else mask.astype(np.float32)
        for picture, mask in zip(pictures, valid, strict=True)
    ]
    spread_px = max(max(picture.shape) for picture in pictures) / _SPREAD
    flat = [_whitened(normalised(picture, mask, spread_px), mask) for picture, mask in zip(pictures, ones, strict=True)]
    canvas = int(np.ceil(np.hypot(*flat[1].shape) / search.scales.min())) | 1
    still = _Still.of(flat[0], ones[0], canvas)
    found, spreads = [], []
    for scale in search.scales:
        turned = _Turned.of(flat[1], ones[1], search.turns_rad, float(scale), canvas, still.size)
        for spectra in (turned, turned.opposite())[: 2 if search.opposites else 1]:
            scores = still.scores(spectra, search.least_overlap)
            spreads.append(float(scores.std()))
            found += list(_best(scores, spectra, canvas, search, flat[0].shape))
    spread = float(np.median(spreads)) or 1.0
    ranked = sorted((Candidate(item.score / spread, item.matrix) for item in found), key=lambda item: -item.score)
    return _apart(ranked, flat[0].shape)


def _whitened(flat: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) with a flat spectrum where it is known, 0 elsewhere, deviation 1."""
    import cv2
    from scipy import fft

    size = fft.next_fast_len(2 * max(flat.shape), real=True)
    framed = cv2.copyMakeBorder(known, 2, 2, 2, 2, cv2.BORDER_CONSTANT)
    window = cv2.GaussianBlur(framed, (0, 0), 2.0)[2:-2, 2:-2] * known
    spectrum = fft.fft2(flat * window, (size, size))
    power = fft.fftshift((spectrum * spectrum.conj()).real.astype(np.float32))
    power = fft.ifftshift(cv2.GaussianBlur(power, (0, 0), _SMOOTH, borderType=cv2.BORDER_REFLECT))
    frequencies = np.fft.fftfreq(size)
    fade = np.exp(-0.5 * (frequencies / _FINEST) ** 2)
    least = _FAINT * np.sqrt(float(power.mean())) + 1e-9
    even = spectrum / np.maximum(np.sqrt(power), least) * np.outer(fade, fade)
    found = fft.ifft2(even)[: flat.shape[0], : flat.shape[1]].real.astype(np.float32) * known
    return np.asarray(found / (np.sqrt((found**2).sum() / max(float(known.sum()), 1.0)) + 1e-9), np.float32)


@dataclass(frozen=True, eq=False)
class _Still:
    """Conjugate spectra of side 0: of the picture at `size`, of its mask at half of it. area: of the mask."""

    picture: NDArray[np.complex64]
    mask: NDArray[np.complex64]
    size: int
    area: float

    @classmethod
    def of(cls, flat: NDArray[np.float32], known: NDArray[np.float32], canvas: int) -> _Still:
        from scipy import fft

        # Shifts that leave little overlap may wrap around: a tenth of a transform's length is saved.
        need = int(0.85 * (max(flat.shape) + canvas))
        size = 2 * fft.next_fast_len(-(-need // 2), real=True)
        mask = np.zeros((size, size), np.float32)
        mask[: known.shape[0], : known.shape[1]] = known
        half = np.conj(fft.rfft2(_halved(mask)))
        return cls(np.conj(fft.rfft2(flat, (size, size))), half, size, float(known.sum()))

    def scores(self, turned: _Turned, least_overlap: float) -> NDArray[np.float32]:
        """(T, size, size) correlation over the root of the overlap's area; 0 where the overlap is small."""
        from scipy import fft

        half = self.size // 2
        products = fft.irfft2(turned.pictures * self.picture, (self.size, self.size))
        areas = 4.0 * fft.irfft2(turned.masks * self.mask, (half, half))
        least = least_overlap * min(self.area, turned.area)
        weights = np.where(areas >= least, 1.0 / np.sqrt(np.maximum(areas, 1.0)), 0.0).astype(np.float32)
        blocks = products.reshape(-1, half, 2, half, 2) * weights[:, :, None, :, None]
        return np.asarray(blocks.reshape(products.shape))


@dataclass(frozen=True, eq=False)
class _Turned:
    """Spectra (T, ...) of side 1, turned and scaled about its middle on a square canvas; (3, 3) px1 from canvas px."""

    pictures: NDArray[np.complex64]
    masks: NDArray[np.complex64]
    px1_from_canvas: tuple[FloatArray, ...]
    canvas: int
    size: int
    area: float

    @classmethod
    def of(
        cls,
        flat: NDArray[np.float32],
        known: NDArray[np.float32],
        turns: FloatArray,
        scale: float,
        canvas: int,
        size: int,
    ) -> _Turned:
        import cv2
        from scipy import fft

        height, width = flat.shape
        half = (canvas + 1) // 2
        pictures = np.zeros((len(turns), size, size), np.float32)
        masks = np.zeros((len(turns), size // 2, size // 2), np.float32)
        matrices = []
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for index, turn in enumerate(turns):
            matrix = _about((width - 1) / 2.0, (height - 1) / 2.0, float(turn), scale, (canvas - 1) / 2.0)
            pictures[index, :canvas, :canvas] = cv2.warpAffine(flat, matrix[:2], (canvas, canvas), flags=flags)
            coarse = matrix @ np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
            masks[index, :half, :half] = cv2.warpAffine(known, coarse[:2], (half, half), flags=flags)
            matrices.append(matrix)
        area = float(known.sum()) / scale**2
        return cls(fft.rfft2(pictures), fft.rfft2(masks), tuple(matrices), canvas, size, area)

    def opposite(self) -> _Turned:
        """Turned by 180 degrees more: the canvas mirrored at its middle."""
        middle = self.canvas - 1.0
        mirror = np.array([[-1.0, 0.0, middle], [0.0, -1.0, middle], [0.0, 0.0, 1.0]])
        matrices = tuple(matrix @ mirror for matrix in self.px1_from_canvas)
        # The masks' canvas has half the pixels: its own last one is at (canvas + 1) / 2 - 1.
        pictures, masks = _mirrored(self.pictures, self.size, middle), _mirrored(self.masks, self.size // 2, middle / 2)
        return _Turned(pictures, masks, matrices, self.canvas, self.size, self.area)


def _mirrored(spectra: NDArray[np.complex64], size: int, last: float) -> NDArray[np.complex64]:
    """Spectra of pictures read from `last` backwards along both axes."""
    down = np.exp(-2j * np.pi * np.fft.fftfreq(size) * last)
    across = np.exp(-2j * np.pi * np.arange(spectra.shape[2]) / size * last)
    return np.asarray(np.conj(spectra) * (down[:, None] * across).astype(np.complex64))


def _about(x: float, y: float, turn: float, scale: float, middle: float) -> FloatArray:
    """(3, 3) that takes the canvas' middle to (x, y)."""
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[cosine, -sine], [sine, cosine]])
    shift = np.array([x, y]) - linear @ np.array([middle, middle])
    return np.vstack([np.column_stack([linear, shift]), [0.0, 0.0, 1.0]])


def _halved(mask: NDArray[np.float32]) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.resize(mask, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def _best(
    scores: NDArray[np.float32], turned: _Turned, canvas: int, search: Search, shape: tuple[int, ...]
) -> Iterator[Candidate]:
    """The best shift of every turn, within reach of what is expected."""
    size = scores.shape[1]
    middle = np.array([(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0, 1.0])
    # Every shift stands for those a whole transform away too: meant is that which leaves most overlap.
    across, down = (
        (np.arange(size) - low) % size + low
        for low in ((canvas - length - size) // 2 for length in (shape[1], shape[0]))
    )
    for matrix, score in zip(turned.px1_from_canvas, scores, strict=True):
        if search.expected is not None:
            # The canvas place of side 0's middle where the expected similarity holds, and the shift that it needs.
            wanted = np.linalg.inv(matrix) @ search.expected @ middle - middle
            near = ((down[:, None] - wanted[1]) ** 2 + (across[None] - wanted[0]) ** 2) <= search.reach_px**2
            score = np.where(near, score, 0.0)
        row, column = divmod(int(np.argmax(score)), size)
        shift = np.array([[1.0, 0.0, across[column]], [0.0, 1.0, down[row]], [0.0, 0.0, 1.0]])
        if score[row, column] > 0.0:
            yield Candidate(float(score[row, column]), matrix @ shift)


def _apart(ranked: Sequence[Candidate], shape: tuple[int, ...]) -> list[Candidate]:
    """Without those that say much the same as a better one."""
    middle = np.array([(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0, 1.0])
    places = np.array([item.matrix[:2] @ middle for item in ranked]).reshape(-1, 2)
    turns = np.array([np.arctan2(item.matrix[1, 0], item.matrix[0, 0]) for item in ranked])
    kept: list[int] = []
    for index in range(len(ranked)):
        off = np.linalg.norm(places[kept] - places[index], axis=1)
        turn = np.abs((turns[kept] - turns[index] + np.pi) % (2.0 * np.pi) - np.pi)
        if not ((off < _SAME_PX) & (turn < _SAME_RAD)).any():
            kept.append(index)
    return [ranked[index] for index in kept]
