"""Rows: all pairs of one image in one file, redone pair by pair. What match and filter share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from aeromatch_cli.data import PairGeometry
from aeromatch_cli.errors import BrokenFileError, WorkspaceError
from aeromatch_cli.executor import guarded
from aeromatch_cli.formats.features import known_fingerprint
from aeromatch_cli.formats.rows import UNKNOWN, MatchEntry, VerifiedEntry
from aeromatch_cli.stages.naming import names_on_file
from aeromatch_cli.workspace import Workspace


class Entry(Protocol):
    """Requires of an entry of a row, which holds one pair, that it states its fingerprint."""

    @property
    def fingerprint(self) -> str: ...


E = TypeVar("E", bound=Entry)


@dataclass(frozen=True, eq=False)
class PairTask:
    """One pair of a row: its geometry, the fingerprint that its result must carry, and the seed of what is random."""

    geometry: PairGeometry
    fingerprint: str
    seed: int

    @property
    def image_id1(self) -> str:
        return self.geometry.pair.image_id1


@dataclass(frozen=True, eq=False)
class Row(Generic[E]):
    """entries: of all pairs that could be made, in order; made: the new ones among them; failures: (pair, reason)."""

    entries: tuple[E, ...]
    made: tuple[E, ...]
    failures: tuple[tuple[str, str], ...]


def redo(image_id0: str, pairs: Sequence[PairTask], old: Mapping[str, E], make: Callable[[PairTask], E]) -> Row[E]:
    """Keep the entries that carry the wanted fingerprint, make the others; one failing pair does not stop the rest."""
    entries, made, failures = [], [], []
    wanted = {pair.image_id1 for pair in missing(pairs, old)}
    for pair in pairs:
        entry = old.get(pair.image_id1)
        if entry is None or pair.image_id1 in wanted:
            outcome = guarded(make, pair)
            if outcome.value is None:
                failures.append((f"{image_id0} {pair.image_id1}", outcome.error))
                continue
            entry = outcome.value
            made.append(entry)
        entries.append(entry)
    return Row(tuple(entries), tuple(made), tuple(failures))


def missing(pairs: Sequence[PairTask], old: Mapping[str, E]) -> list[PairTask]:
    """Return the pairs without an entry that carries the wanted fingerprint."""
    on_file = {image_id1: entry.fingerprint for image_id1, entry in old.items()}
    return [pair for pair in pairs if on_file.get(pair.image_id1) != pair.fingerprint]


def features_of(workspace: Workspace, image_id0: str, image_id1: str) -> tuple[str, str]:
    """Return the fingerprints of the features on file: what an entry that is made now points into."""
    return features_on_file(workspace, image_id0), features_on_file(workspace, image_id1)


def features_on_file(workspace: Workspace, image_id: str) -> str:
    """Return the fingerprint of an image's features, "" of none."""
    return known_fingerprint(workspace.features(image_id)) or ""


def stale_image(image_id0: str, entry: MatchEntry | VerifiedEntry, features: Callable[[str], str]) -> str:
    """Return the image whose features were made again after the pair was matched, so that its matches' numbers mean
    other keypoints; "" where there is none. features: `features_on_file` of a workspace."""
    if entry.features == UNKNOWN:
        return ""
    for image_id, made_of in zip((image_id0, entry.image_id1), entry.features, strict=True):
        if features(image_id) not in (made_of, ""):
            return image_id
    return ""


def check_features(
    workspace: Workspace,
    image_id0: str,
    entry: MatchEntry | VerifiedEntry,
    features: Callable[[str], str] | None = None,
) -> None:
    """Raises WorkspaceError where an entry's matches point into features that are no longer there. features: as
    `stale_image` has them, by default from their files."""
    if image_id := stale_image(image_id0, entry, features or partial(features_on_file, workspace)):
        name = names_on_file(workspace).get(image_id, image_id)
        raise WorkspaceError(
            f"{workspace.root}: the keypoints of {name} were found again with other settings or inputs after it "
            "was matched, so that its matches no longer hold: run `aeromatch match` and then `aeromatch filter`, or "
            "`aeromatch run`"
        )


def readable(read: Callable[[Path], dict[str, E]], path: Path, overwrite: bool) -> dict[str, E]:
    """Return the row on file as far as it is wanted and can be read: a broken file is made again."""
    if overwrite:
        return {}
    try:
        return read(path)
    except BrokenFileError:
        return {}


def is_done(pairs: Sequence[PairTask], on_file: Mapping[str, str]) -> bool:
    """Return whether exactly the wanted pairs are there, each up to date: pairs that are no longer wanted leave the
    file."""
    return dict(on_file) == {pair.image_id1: pair.fingerprint for pair in pairs}


def kept(pairs: Sequence[PairTask], on_file: Mapping[str, str]) -> int:
    """Count the wanted pairs that are on file and up to date."""
    return sum(on_file.get(pair.image_id1) == pair.fingerprint for pair in pairs)
