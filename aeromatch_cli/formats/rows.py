"""The workspace's rows: matches and verified matches of all pairs of one image."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import (
    FloatArray,
    IntArray,
    Matches,
    Verdict,
)
from aeromatch_cli.formats.archives import ARCHIVE_FAULTS, load_all, save_arrays
from aeromatch_cli.formats.reading import readable

# Features of rows that earlier versions wrote.
UNKNOWN = ("", "")


@dataclass(frozen=True, eq=False)
class MatchEntry:
    """One pair of a matches row. features: fingerprints of both images' features that its numbers point into."""

    image_id1: str
    fingerprint: str
    strategy: str
    matches: Matches
    features: tuple[str, str] = UNKNOWN


@dataclass(frozen=True, eq=False)
class VerifiedEntry:
    """One pair of a verified row: the kept matches and what the filters said (verdict.keep is all True here).

    features: fingerprints of both images' features that the matches' numbers point into.
    """

    image_id1: str
    fingerprint: str
    matches_in: int
    matches: Matches
    verdict: Verdict
    features: tuple[str, str] = UNKNOWN


def write_match_row(stream: BinaryIO, entries: Sequence[MatchEntry]) -> None:
    arrays = _row_arrays(entries)
    arrays["strategy"] = _strings([e.strategy for e in entries])
    arrays["view_pairs"] = _joined([e.matches.view_pairs for e in entries], (0, 2), np.int16)
    if any(e.matches.remark for e in entries):
        arrays["remark"] = _strings([e.matches.remark for e in entries])
    save_arrays(stream, **arrays)


def read_match_row(path: Path) -> dict[str, MatchEntry]:
    """Entries by image_id1; empty when the file is absent. Raises BrokenFileError when it is broken."""
    if not path.exists():
        return {}
    row = _Row(path)
    with readable(path, *ARCHIVE_FAULTS):
        view_pairs, strategy = row["view_pairs"], row["strategy"]
        return {
            id1: MatchEntry(id1, fp, str(strategy[p]), row.matches(p, view_pairs), row.features(p))
            for p, (id1, fp) in enumerate(row.keys())
        }


def write_verified_row(stream: BinaryIO, entries: Sequence[VerifiedEntry]) -> None:
    verdicts = [e.verdict for e in entries]
    rotations = [np.full((3, 3), np.nan) if v.relative_rotation is None else v.relative_rotation for v in verdicts]
    errors = [
        np.full(len(e.matches.indices), np.nan) if e.verdict.errors_px is None else e.verdict.errors_px for e in entries
    ]
    save_arrays(
        stream,
        **_row_arrays(entries),
        errors_px=_joined(errors, (0,), np.float32),
        state=_strings([v.state for v in verdicts]),
        reason=_strings([v.reason for v in verdicts]),
        model_kind=_strings([v.model_kind for v in verdicts]),
        models=np.array([v.model for v in verdicts], dtype=np.float64).reshape(-1, 3, 3),
        rotations=np.array(rotations, dtype=np.float64).reshape(-1, 3, 3),
        matches_in=np.array([e.matches_in for e in entries], dtype=np.int64),
        rejected=_strings([json.dumps(dict(v.rejected)) for v in verdicts]),
    )


def read_verified_row(path: Path) -> dict[str, VerifiedEntry]:
    """Entries by image_id1; empty when the file is absent. Raises BrokenFileError when it is broken."""
    if not path.exists():
        return {}
    row = _Row(path)
    with readable(path, *ARCHIVE_FAULTS):
        return {id1: _verified_entry(row, p, id1, fp) for p, (id1, fp) in enumerate(row.keys())}


def _verified_entry(row: _Row, p: int, image_id1: str, fingerprint: str) -> VerifiedEntry:
    matches = row.matches(p, None)
    rotation = row["rotations"][p]
    verdict = Verdict(
        keep=np.ones(len(matches.indices), dtype=bool),
        state=str(row["state"][p]),  # type: ignore[arg-type]
        reason=str(row["reason"][p]),
        model_kind=str(row["model_kind"][p]),
        model=row["models"][p],
        errors_px=row["errors_px"][row.span(p)],
        rejected=json.loads(str(row["rejected"][p])),
        relative_rotation=None if np.isnan(rotation).any() else rotation,
    )
    return VerifiedEntry(image_id1, fingerprint, int(row["matches_in"][p]), matches, verdict, row.features(p))


class _Row:
    """A row archive, read once."""

    def __init__(self, path: Path) -> None:
        self._arrays = load_all(path)
        with readable(path, *ARCHIVE_FAULTS):
            self._offsets = self._arrays["offsets"]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._arrays[name]

    def keys(self) -> list[tuple[str, str]]:
        return [(str(i), str(f)) for i, f in zip(self["image_id1"], self["fingerprint"], strict=True)]

    def span(self, p: int) -> slice:
        return slice(int(self._offsets[p]), int(self._offsets[p + 1]))

    def features(self, p: int) -> tuple[str, str]:
        if "features0" not in self._arrays:
            return UNKNOWN
        return str(self["features0"][p]), str(self["features1"][p])

    def matches(self, p: int, view_pairs: IntArray | None) -> Matches:
        span = self.span(p)
        indices = self["indices"][span]
        measured = "points0_px" in self._arrays
        return Matches(
            indices,
            self["scores"][span],
            np.zeros((len(indices), 2), np.int16) if view_pairs is None else view_pairs[span],
            self["points0_px"][span] if measured else None,
            self["points1_px"][span] if measured else None,
            self["sigmas_px"][span] if "sigmas_px" in self._arrays else None,
            str(self["remark"][p]) if "remark" in self._arrays else "",
        )


def _row_arrays(entries: Sequence[MatchEntry] | Sequence[VerifiedEntry]) -> dict[str, NDArray[Any]]:
    matches = [e.matches for e in entries]
    arrays: dict[str, NDArray[Any]] = {
        "image_id1": _strings([e.image_id1 for e in entries]),
        "fingerprint": _strings([e.fingerprint for e in entries]),
        "features0": _strings([e.features[0] for e in entries]),
        "features1": _strings([e.features[1] for e in entries]),
        "offsets": np.cumsum([0, *(len(m.indices) for m in matches)], dtype=np.int64),
        "indices": _joined([m.indices for m in matches], (0, 2), np.int32),
        "scores": _joined([m.scores for m in matches], (0,), np.float32),
    }
    if any(m.points0_px is not None for m in matches):
        arrays["points0_px"] = _joined([_known(m, m.points0_px, (2,)) for m in matches], (0, 2), np.float64)
        arrays["points1_px"] = _joined([_known(m, m.points1_px, (2,)) for m in matches], (0, 2), np.float64)
    if any(m.sigmas_px is not None for m in matches):
        arrays["sigmas_px"] = _joined([_known(m, m.sigmas_px, ()) for m in matches], (0,), np.float32)
    return arrays


def _known(matches: Matches, values: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    """Return values (M, *shape) of matches (M,), NaN where a pair has none."""
    return np.full((len(matches.indices), *shape), np.nan) if values is None else values


def _joined(parts: Sequence[NDArray[Any]], empty_shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(empty_shape, dtype)


def _strings(values: Sequence[str]) -> NDArray[Any]:
    return np.array(values, dtype=np.str_) if values else np.zeros(0, dtype="<U1")
