"""The block as the files of a workspace tell it, without the arrays: which images have features, and of which pairs
there are matches and verdicts, made of what.

The index knows it of files that have not changed; of the others it is read from them. A file that is damaged counts as
absent here; whoever reads its arrays says that it is.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.files import changed_files, read_json, read_record
from aeromatch_cli.fingerprints import file_digest
from aeromatch_cli.formats.features import checked_features
from aeromatch_cli.formats.reading import say_damaged
from aeromatch_cli.formats.rows import MatchEntry, VerifiedEntry, read_match_row, read_verified_row
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.store.index import Index
from aeromatch_cli.words import form, listed
from aeromatch_cli.workspace import Workspace

log = logging.getLogger("aeromatch")

_FEATURES, _MATCHES, _VERDICTS, _RECORD, _DIGEST = "features", "matches", "verdicts", "record", "digest"


class KnownFeatures(NamedTuple):
    """fingerprint: of what the features were made of. keypoints: how many there are."""

    fingerprint: str
    keypoints: int


class KnownMatches(NamedTuple):
    """The matches of a pair. fingerprint: of what they were made of. features: fingerprints of both images' features
    that they point into, "" where that is not known. matches: how many. strategy: name of the matcher."""

    fingerprint: str
    features: tuple[str, str]
    matches: int
    strategy: str


class KnownVerdict(NamedTuple):
    """The verdict on a pair. fingerprint, features: as for its matches. state: verified, rejected or not verifiable.
    matches: how many are kept. matches_in: of those that were judged."""

    fingerprint: str
    features: tuple[str, str]
    state: str
    reason: str
    matches: int
    matches_in: int


def matches_of(entries: Iterable[MatchEntry]) -> dict[str, KnownMatches]:
    """Return what is known of the pairs of a row, by image_id1."""
    return {e.image_id1: KnownMatches(e.fingerprint, e.features, len(e.matches.indices), e.strategy) for e in entries}


def verdicts_of(entries: Iterable[VerifiedEntry]) -> dict[str, KnownVerdict]:
    """Return what is known of the pairs of a row, by image_id1."""
    return {
        e.image_id1: KnownVerdict(
            e.fingerprint, e.features, e.verdict.state, e.verdict.reason, len(e.matches.indices), e.matches_in
        )
        for e in entries
    }


@dataclass(frozen=True, eq=False)
class BlockStore:
    """What a workspace holds. Only the process that coordinates a command asks it."""

    workspace: Workspace
    index: Index

    def features(self, image_id: str) -> KnownFeatures | None:
        """Return what is known of an image's features; None where it has none."""
        found = self._known(_FEATURES, self.workspace.features(image_id), checked_features)
        return None if found is None else KnownFeatures(*found)

    def features_fingerprint(self, image_id: str) -> str:
        """Return the fingerprint of an image's features, "" of none."""
        found = self.features(image_id)
        return "" if found is None else found.fingerprint

    def matches(self, image_id0: str) -> dict[str, KnownMatches]:
        """Return what is known of the matches of an image's row, by image_id1."""
        found = self._known(_MATCHES, self.workspace.matches(image_id0), _read_matches)
        return {i: KnownMatches(made_of, (f0, f1), *rest) for i, (made_of, (f0, f1), *rest) in (found or {}).items()}

    def verdicts(self, image_id0: str) -> dict[str, KnownVerdict]:
        """Return what is known of the verdicts of an image's row, by image_id1."""
        found = self._known(_VERDICTS, self.workspace.verified(image_id0), _read_verdicts)
        return {i: KnownVerdict(made_of, (f0, f1), *rest) for i, (made_of, (f0, f1), *rest) in (found or {}).items()}

    def made_features(self, image_id: str, known: KnownFeatures) -> None:
        """Learn of features that a worker has written."""
        self.index.put(_FEATURES, self.workspace.features(image_id), known)

    def made_matches(self, image_id0: str, known: Mapping[str, KnownMatches]) -> None:
        """Learn of a row of matches that a worker has written."""
        self.index.put(_MATCHES, self.workspace.matches(image_id0), known)

    def made_verdicts(self, image_id0: str, known: Mapping[str, KnownVerdict]) -> None:
        """Learn of a row of verdicts that a worker has written."""
        self.index.put(_VERDICTS, self.workspace.verified(image_id0), known)

    def record(self, path: Path) -> dict[str, Any]:
        """Return a record in JSON, where the files that it names beside it are as they were written; else nothing."""
        found: dict[str, Any] = self._known(_RECORD, path, read_json) or {}
        return {} if self.changed(path.parent, found.get("files", {})) else found

    def report(self, stage: str) -> StageRecord | None:
        """Return what a stage of the whole block has left, where the files that it names are as they were written; else
        None, and a word says which is not."""
        record = read_record(self.workspace.stage_report(stage), StageRecord)
        changed = [] if record is None else self.changed(self.workspace.root, record.files)
        if changed:
            one, several = (
                "was changed or removed since it was written, and counts",
                "were changed or removed, and count",
            )
            words = form(len(changed), one, several)
            log.warning("warning: %s %s as absent", listed((self.workspace.root / name for name in changed), 1), words)
        return None if changed else record

    def changed(self, folder: Path, digests: Mapping[str, str]) -> list[str]:
        """Return the names of files below a folder that are gone or have other digests than these."""
        return changed_files(folder, digests, self.digest)

    def digest(self, path: Path) -> str:
        """Return the SHA-256 of a file, which is read where it has changed since that was asked last."""
        return str(self.index.read(_DIGEST, path, file_digest))

    def _known(self, what: str, path: Path, read: Callable[[Path], Any]) -> Any:
        try:
            return self.index.read(what, path, read)
        except FileNotFoundError:
            return None
        except BrokenFileError as error:
            if not path.is_file():
                return None
            say_damaged(path, error)
            return None


def _read_matches(path: Path) -> dict[str, KnownMatches]:
    return matches_of(read_match_row(path).values())


def _read_verdicts(path: Path) -> dict[str, KnownVerdict]:
    return verdicts_of(read_verified_row(path).values())


def stale_image(ids: Sequence[str], features: tuple[str, str], of: Callable[[str], str]) -> str:
    """Return the image of a pair whose features were made again after the pair was matched, so that its matches'
    numbers mean other keypoints; "" where there is none.

    features: fingerprints that the matches point into. of: gives that of an image's features, "" of none.
    """
    for image_id, made_of in zip(ids, features, strict=True):
        if made_of and of(image_id) not in (made_of, ""):
            return image_id
    return ""
