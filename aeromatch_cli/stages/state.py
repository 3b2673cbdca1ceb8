"""The state of the block: what results must be made of by the present settings and inputs, and which of them exist."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from aeromatch_cli import graph
from aeromatch_cli.data import Pair
from aeromatch_cli.errors import InputError
from aeromatch_cli.files import read_record
from aeromatch_cli.fingerprints import canonical, combined, fingerprint, stable_hash
from aeromatch_cli.formats.rows import VerifiedEntry, read_verified_row
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.stages import extract
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.store.block_store import KnownVerdict, stale_image
from aeromatch_cli.strategies import Matcher
from aeromatch_cli.strategies.filters.chain import VERSION as CHAIN_VERSION
from aeromatch_cli.strategies.matchers.descriptors.search import Search

# Pairs and their verdicts, in the order of pairs.csv.
Judged = Iterator[tuple[Pair, VerifiedEntry]]


@dataclass(frozen=True, eq=False)
class BlockState:
    """Images and pairs of a context, what they have on file, and whether that is up to date: it is where it carries
    the fingerprint that `wanted_features`, `wanted_matches` or `wanted_verdict` gives. Each is computed once."""

    context: Context

    @classmethod
    def of(cls, context: Context) -> BlockState:
        """Return the state of a context, which is the same one as long as the context stays."""
        return context.once("state", make=lambda: cls(context))

    # --- what results must be made of --------------------------------------------------------------------------------

    def wanted_features(self, image_id: str) -> str:
        """Return the fingerprint that the features of an image must carry."""
        if self.context.scope.joined is not None:
            return self.context.scope.joined.features.get(image_id, "")
        return extract.task_of(self.context, image_id).fingerprint

    def wanted_matches(self, pair: Pair) -> str:
        """Return the fingerprint that the matches of a pair must carry: of the matcher, both images' features, and
        their geometry."""
        if self.context.scope.joined is not None:
            return self.context.scope.joined.matches.get((pair.image_id0, pair.image_id1), "")
        return self.context.once("matches", *pair.ids, make=lambda: self._matches(pair))

    def _matches(self, pair: Pair) -> str:
        context, matcher = self.context, self.matcher(pair)
        overlap = str(pair.overlap) if matcher.reads_pixels else ""  # where it is small, poses are not doubted
        how = context.once("matches", matcher is context.settings.match, make=lambda: self._how_matched(matcher))
        needs = matcher.reads()
        sides = [(extract.task_of(context, i).fingerprint, context.geometry_fingerprint(i, needs)) for i in pair.ids]
        return combined(*how, canonical(sides), canonical(overlap))

    def _how_matched(self, matcher: Matcher) -> tuple[str, ...]:
        """Return what the matches of all pairs of one matcher depend on, as canonical text."""
        return canonical(matcher), canonical(self.context.scope.continues), canonical(library_version("poselib"))

    def matcher(self, pair: Pair) -> Matcher:
        """Return the matcher of a pair: guided for an image that the first pass could not tie to the others."""
        chosen: Matcher = self.context.settings.match
        untied = self.context.block.outside & set(pair.ids)
        return chosen.model_copy(update={"guided": True}) if untied and isinstance(chosen, Search) else chosen

    def wanted_verdict(self, pair: Pair) -> str:
        """Return the fingerprint that the verdict on a pair must carry: of the chain, the matches, the geometry that
        the chain reads, and the seed."""
        return self.context.once("verdict", *pair.ids, make=lambda: self._verdict(pair))

    def _verdict(self, pair: Pair) -> str:
        how, needs = self.context.once("verdict", make=self._how_judged)
        sides = [self.context.geometry_fingerprint(i, needs) for i in pair.ids]
        return combined(*how, *map(canonical, (self.wanted_matches(pair), sides, self.seed(pair))))

    def _how_judged(self) -> tuple[tuple[str, ...], frozenset[str]]:
        """Return what the verdicts on all pairs depend on, as canonical text, and what the chain needs of the
        geometry."""
        chain = self.context.settings.filter
        needs = frozenset[str]().union(*(strategy.needs for strategy in chain))
        return (canonical(CHAIN_VERSION), canonical(chain), canonical(library_version("poselib"))), needs

    def seed(self, pair: Pair) -> int:
        """Return the random seed of a pair, which is the same whatever else is in the block."""
        return stable_hash(f"{self.context.settings.seed} {pair.image_id0} {pair.image_id1}") % (1 << 31)

    def inputs_fingerprint(self, stage: str) -> str:
        """Return the fingerprint of what a stage of the whole block is declared to read from the workspace.

        What stages make of images and pairs is told by the fingerprints that the verdicts of the pairs must carry, in
        which those of features and matches are; what stages of the whole block make, by the SHA-256 of the files. A
        test compares the declarations with the files that stages open, so that nothing is forgotten here.
        """
        kinds = graph.BY_NAME[stage].reads
        makers = [one for one in graph.STAGES if set(one.writes) & set(kinds)]
        whole = [one.name for one in makers if one.unit == "block" or one.name == "refine"]
        parts: list[Any] = [(name, self._files(name)) for name in whole]
        if any(one.unit == "pair" for one in makers):
            parts.append([(*pair.ids, self.wanted_verdict(pair)) for pair in self.context.pairs])
        return fingerprint(parts)

    def _files(self, stage: str) -> dict[str, str]:
        """Return the SHA-256 of the files that a stage has left, by their names in the workspace."""
        record = read_record(self.context.workspace.stage_report(stage), StageRecord)
        return {} if record is None else record.files

    # --- what is on file ---------------------------------------------------------------------------------------------

    def with_features(self, image_ids: Iterable[str]) -> set[str]:
        """Return those of the images whose features on file are up to date."""
        store = self.context.store
        return {
            i for i in set(image_ids) if (known := store.features(i)) and known.fingerprint == self.wanted_features(i)
        }

    def are_matched(self, pair: Pair) -> bool:
        """Whether the matches of a pair on file are up to date."""
        known = self.context.store.matches(pair.image_id0).get(pair.image_id1)
        return known is not None and known.fingerprint == self.wanted_matches(pair)

    def outdated_pairs(self) -> list[Pair]:
        """Return the pairs whose verdict, or the features that it points into, is not up to date."""
        features = self.with_features(image_id for pair in self.context.pairs for image_id in pair.ids)
        outdated = []
        for image_id0, pairs in self.context.rows().items():
            judged = self.context.store.verdicts(image_id0)
            for pair in pairs:
                verdict = judged.get(pair.image_id1)
                if (
                    verdict is None
                    or verdict.fingerprint != self.wanted_verdict(pair)
                    or not features.issuperset(pair.ids)
                ):
                    outdated.append(pair)
        return outdated

    def with_current_pairs(self) -> tuple[Context, list[Pair]]:
        """Return the context with the pairs whose results are up to date, and the other pairs. InputError where none is
        left."""
        outdated = self.outdated_pairs()
        if not outdated and self.context.pairs:
            return self.context, outdated
        absent = {pair.ids for pair in outdated}
        pairs = [pair for pair in self.context.pairs if pair.ids not in absent]
        if not pairs:
            raise InputError(
                "no pair is matched and filtered with the present settings and inputs; run `aeromatch match` and then "
                "`aeromatch filter` (`aeromatch run` does everything), and see failures.csv"
            )
        return replace(self.context, pairs=tuple(pairs)), outdated

    def known_verdicts(self) -> Iterator[tuple[Pair, KnownVerdict]]:
        """Yield what is known of judged pairs, as `judged_pairs` has them, without their matches."""
        store, row_id, row = self.context.store, "", dict[str, KnownVerdict]()
        features = cache(store.features_fingerprint)
        for pair in self.context.pairs:
            if pair.image_id0 != row_id:
                row_id, row = pair.image_id0, store.verdicts(pair.image_id0)
            known = row.get(pair.image_id1)
            if known is not None and not stale_image(pair.ids, known.features, features):
                yield pair, known

    def judged_pairs(self, features: Callable[[str], str] | None = None) -> Judged:
        """Yield judged pairs in the order of pairs.csv: stale rows, of older pair lists or features that were made
        again since, cannot leak. features: fingerprint of an image's features, "" of none; by default that on file."""
        row_id, row = "", dict[str, VerifiedEntry]()
        features = features or cache(self.context.store.features_fingerprint)
        for pair in self.context.pairs:
            if pair.image_id0 != row_id:
                row_id, row = pair.image_id0, read_verified_row(self.context.workspace.verified(pair.image_id0))
            entry = row.get(pair.image_id1)
            if entry is not None and not stale_image(pair.ids, entry.features, features):
                yield pair, entry
