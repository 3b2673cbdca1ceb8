"""Matches as they are read: where their points lie, and which verified ones are final: those that the stage consistency
has not dropped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, Matches, Verdict
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.formats.adjusted import read_dropped
from aeromatch_cli.formats.rows import MatchEntry, VerifiedEntry
from aeromatch_cli.store.block_store import stale_image
from aeromatch_cli.store.naming import names_on_file
from aeromatch_cli.workspace import Workspace


class FinalEntries:
    """Gives what is left of verified entries, by what a workspace has on file; all, where that is of other results."""

    def __init__(self, workspace: Workspace) -> None:
        self._dropped, self._least = read_dropped(workspace.dropped)

    def kept(self, image_id0: str, entry: VerifiedEntry) -> BoolArray:
        """(M,) of an entry's matches: none where so few are left that the pair is rejected."""
        keep = self._not_dropped(image_id0, entry)
        if keep is None:
            return np.ones(len(entry.matches.indices), dtype=bool)
        return keep if keep.sum() >= self._least else np.zeros(len(keep), dtype=bool)

    def _not_dropped(self, image_id0: str, entry: VerifiedEntry) -> BoolArray | None:
        """(M,) of an entry's matches; None where none is dropped."""
        made_of, rows = self._dropped.get((image_id0, entry.image_id1), ("", None))
        if rows is None or made_of != entry.fingerprint:
            return None
        keep = np.ones(len(entry.matches.indices), dtype=bool)
        keep[rows] = False
        return keep

    def left(self, image_id0: str, entry: VerifiedEntry) -> VerifiedEntry:
        """Return what is left of an entry whose matches are known to be of the present features."""
        if (keep := self._not_dropped(image_id0, entry)) is None:
            return entry
        left, verdict = select(entry.matches, keep), entry.verdict
        errors = None if verdict.errors_px is None else verdict.errors_px[keep]
        rejected = {**verdict.rejected, "consistency": int((~keep).sum())}
        verdict = replace(verdict, keep=np.ones(len(left.indices), dtype=bool), errors_px=errors, rejected=rejected)
        if len(left.indices) < self._least:
            words = f"{len(left.indices)} of {len(keep)} matches are left: others contradict the block, or are unlikely"
            nothing = np.zeros(0, dtype=bool)
            rejected["consistency"] = len(keep)
            verdict = Verdict(nothing, "rejected", words, rejected=rejected)
            left = select(left, np.zeros(len(left.indices), dtype=bool))
        return replace(entry, matches=left, verdict=verdict)


def match_points(matches: Matches, keypoints0: FloatArray, keypoints1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return stored-pixel points (M, 2) float64 of both sides: keypoints, or the measured place where there is none."""
    sides = []
    for side, (keypoints, measured) in enumerate(((keypoints0, matches.points0_px), (keypoints1, matches.points1_px))):
        indices = matches.indices[:, side]
        if measured is None:
            sides.append(keypoints[indices].astype(np.float64))
        else:
            points = np.array(measured, dtype=np.float64)
            found = indices >= 0
            points[found] = keypoints[indices[found]]
            sides.append(points)
    return sides[0], sides[1]


def select(matches: Matches, keep: Any) -> Matches:
    """Return the matches where `keep` (M,) is true."""
    return Matches(
        matches.indices[keep],
        matches.scores[keep],
        matches.view_pairs[keep],
        None if matches.points0_px is None else matches.points0_px[keep],
        None if matches.points1_px is None else matches.points1_px[keep],
        None if matches.sigmas_px is None else matches.sigmas_px[keep],
    )


def check_features(
    workspace: Workspace, image_id0: str, entry: MatchEntry | VerifiedEntry, features: Callable[[str], str]
) -> None:
    """Raise WorkspaceError where an entry's matches point into features that are no longer there. features: gives the
    fingerprint of an image's features, "" of none."""
    if image_id := stale_image((image_id0, entry.image_id1), entry.features, features):
        name = names_on_file(workspace).get(image_id, image_id)
        raise WorkspaceError(
            f"{workspace.root}: the keypoints of {name} were found again with other settings or inputs after it "
            "was matched, so that its matches no longer hold: run `aeromatch match` and then `aeromatch filter`, or "
            "`aeromatch run`"
        )
