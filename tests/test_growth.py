"""Images that the first pass could not tie are searched for with guidance in the final pass."""

from __future__ import annotations

from dataclasses import replace

import pytest
from conftest import Site

from aeromatch_cli.config import load
from aeromatch_cli.executor import Executor
from aeromatch_cli.stages.pairs import prepare
from aeromatch_cli.stages.state import BlockState

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("matcher", ["nearest", "bidirectional", "lightglue"])
def test_only_pairs_of_images_outside_are_guided(done_site: Site, matcher: str) -> None:
    settings = load(str(done_site.work / "config.yaml"), [f"match={matcher}", "match.guided=false"])
    context, *_ = prepare(settings, Executor("serial"))
    assert not context.block.outside
    lost = context.pairs[0].image_id0
    grown = replace(context, block=replace(context.block, outside=frozenset({lost})))
    untied = [pair for pair in context.pairs if lost in (pair.image_id0, pair.image_id1)]
    assert 0 < len(untied) < len(context.pairs)
    for pair in context.pairs:
        changed = pair in untied
        assert BlockState.of(grown).matcher(pair).guided is changed
        assert (BlockState.of(grown).wanted_matches(pair) != BlockState.of(context).wanted_matches(pair)) is changed


def test_a_matcher_without_guided_search_stays(done_site: Site) -> None:
    settings = load(str(done_site.work / "config.yaml"), ["match=polar", "extract=grid", "filter=poselib"])
    context, *_ = prepare(settings, Executor("serial"))
    everywhere = frozenset(image.image_id for image in context.block.images)
    grown = replace(context, block=replace(context.block, outside=everywhere))
    assert BlockState.of(grown).matcher(context.pairs[0]) is settings.match
