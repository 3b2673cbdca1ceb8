"""Two workspaces side by side: settings that differ, pairs, matches, images and poses, and which is better."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aeromatch_cli import graph
from aeromatch_cli.config import differing, load
from aeromatch_cli.data import Image, Pair
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.report.rows import present_evaluation, seconds_by_stage
from aeromatch_cli.results.stages import AdjustResult, BlockResults
from aeromatch_cli.stages.quality import quality_of, results_of
from aeromatch_cli.stages.settings_diff import said_value
from aeromatch_cli.store.opened import OpenedBlock
from aeromatch_cli.words import MANY, counted, listed
from aeromatch_cli.workspace import Workspace

# Differences that are not chance, as a share of the larger value.
_ERROR_SHARE, _MATCHES_SHARE = 0.1, 0.05
# Settings that change no result.
_OUTWARD = ("workspace", "run")
# Of the images of the larger block: with fewer in common two blocks have nothing to be compared by.
_LEAST_COMMON = 0.5
# Frames of orientation.csv.
_WORLD, _UNORIENTED = "world", "predicted"


class Judged(NamedTuple):
    """What `aeromatch evaluate` found of the present matches by the truth in a folder: how many are correct, and the
    share that is wrong."""

    truth: str
    correct: float
    wrong: float


@dataclass(frozen=True)
class Standing:
    """What speaks for one side; None where it is not known.

    verdict: as `aeromatch run` says it. oriented: images of those in both. georeferenced: those of them that are not in
    a frame of their own, whose scale, north and place are arbitrary. check_m: error at check points, root mean
    square of their distances, and checks: which these are. empty: parts of images (3 x 3 each) without a point though
    other images show them. matches: verified ones of pairs of images in both. judged: by truth, which outranks all
    else.
    """

    verdict: str | None
    oriented: int | None
    georeferenced: int | None
    check_m: float | None
    checks: frozenset[str]
    empty: int | None
    matches: int
    judged: Judged | None = None


@dataclass(frozen=True)
class Criterion:
    """what: its name; first, second: the values as they are shown; better: "first", "second" or "neither"."""

    what: str
    first: str
    second: str
    better: str


def criteria(one: Standing, two: Standing) -> list[Criterion]:
    """All that can be compared, the gravest first."""
    return list(_criteria(one, two))


def verdict_lines(found: Sequence[Criterion]) -> list[str]:
    """Which side is better by the gravest criterion in which they differ, and what else differs."""
    apart = [one for one in found if one.better != "neither"]
    if not apart:
        return [f"better      neither: they differ in nothing that counts ({', '.join(one.what for one in found)})"]
    winner = apart[0].better
    lines = [f"better      the {winner}: {_words(apart[0])}"]
    for words, same in (("and", True), ("but", False)):
        rest = [one for one in apart[1:] if (one.better == winner) == same]
        lines += [f"            {words} the {one.better} in: {_words(one)}" for one in rest]
    return lines


def as_facts(found: Sequence[Criterion]) -> dict[str, Any]:
    """JSON-ready."""
    apart = [one.better for one in found if one.better != "neither"]
    return {"better": apart[0] if apart else "neither", "criteria": [asdict(one) for one in found]}


def _words(one: Criterion) -> str:
    return f"{one.what}, {one.first} in the first and {one.second} in the second"


def _criteria(one: Standing, two: Standing) -> Iterator[Criterion]:
    if one.judged is not None and two.judged is not None and one.judged.truth == two.judged.truth:
        correct, wrong = zip(one.judged[1:], two.judged[1:], strict=True)
        yield _larger("correct matches by `aeromatch evaluate`", correct, None, _MATCHES_SHARE)
        shown = f"{100 * wrong[0]:.1f} %", f"{100 * wrong[1]:.1f} %"
        yield _larger("wrong matches by `aeromatch evaluate`", (-wrong[0], -wrong[1]), shown, _ERROR_SHARE)
    if one.verdict is not None and two.verdict is not None:
        order = ("bad", "doubtful", "good")
        yield _larger("result", (order.index(one.verdict), order.index(two.verdict)), (one.verdict, two.verdict))
    if one.oriented is not None and two.oriented is not None:
        yield _larger("images oriented", (one.oriented, two.oriented))
    if one.georeferenced is not None and two.georeferenced is not None:
        yield _larger("images with scale, north and place", (one.georeferenced, two.georeferenced))
    if one.check_m is not None and two.check_m is not None and one.checks == two.checks:
        shown = f"{one.check_m:.3f} m", f"{two.check_m:.3f} m"
        yield _larger("error at check points", (-one.check_m, -two.check_m), shown, _ERROR_SHARE)
    if one.empty is not None and two.empty is not None:
        shown = str(one.empty), str(two.empty)
        yield _larger("parts of images without points", (-one.empty, -two.empty), shown, _ERROR_SHARE)
    yield _larger("verified matches", (one.matches, two.matches), None, _MATCHES_SHARE)


def _larger(
    what: str, values: tuple[float, float], shown: tuple[str, str] | None = None, share: float = 0.0
) -> Criterion:
    """share: of the larger magnitude, by which values may differ without being better."""
    first, second = values
    even = abs(first - second) <= share * max(abs(first), abs(second))
    words = shown or (f"{first:,.0f}", f"{second:,.0f}")
    if even:
        return Criterion(what, *words, "neither")
    return Criterion(what, *words, "first" if first > second else "second")


@dataclass(frozen=True)
class _Side:
    """images: by name. matches: verified ones by pair of image names. seconds: by stage. results: of the stages.
    oriented: name -> frame of oriented images, None where nothing was adjusted. verdict: on the block, None where its
    stages have not run."""

    settings: Mapping[str, Any]
    images: Mapping[str, Image]
    matches: Mapping[tuple[str, str], int]
    seconds: Mapping[str, float]
    results: BlockResults
    oriented: Mapping[str, str] | None
    verdict: str | None
    judged: Judged | None = None

    @property
    def left_out(self) -> list[str]:
        """What `run --within` did without."""
        return [] if self.results.pairs is None else self.results.pairs.left_out


def compare(first: Path, second: Path) -> tuple[list[str], dict[str, Any]]:
    """In words, and as facts. Raises ConfigError where a folder is no workspace, or their images are not the same,
    InputError where one holds no results yet."""
    one, two = _side(first), _side(second)
    _check_images(first, second, one, two)
    lines = [f"first       {first}", f"second      {second}"]
    apart = differing(one.settings, two.settings)
    changed = [
        f"{key}: {said_value(old)} and {said_value(new)}"
        for key, old, new in apart
        if key.partition(".")[0] not in _OUTWARD
    ]
    lines += [f"setting     {words}" for words in changed] or ["settings    the same"]
    for words, side in (("first", one), ("second", two)):
        if side.left_out:
            lines.append(f"left out    in the {words}, to end in time (run --within): {'; '.join(side.left_out)}")
    lines += [*_image_lines(one, two), *_match_lines(one, two)]
    lines += _block_lines(one.results.final_block, two.results.final_block)
    for stage in (stage for stage in graph.ORDER if stage in one.seconds and stage in two.seconds):
        lines.append(f"seconds     {stage}: {one.seconds[stage]:.1f} and {two.seconds[stage]:.1f}")
    common = one.images.keys() & two.images.keys()
    found = criteria(_standing(one, common), _standing(two, common))
    facts = {"settings": changed, "pairs": [len(one.matches), len(two.matches)],
             "verified": [len(_verified(one)), len(_verified(two))],
             "matches": [sum(side.matches.values()) for side in (one, two)], **as_facts(found)}  # fmt: skip
    return lines + verdict_lines(found), facts


def _check_images(first: Path, second: Path, one: _Side, two: _Side) -> None:
    common = sorted(one.images.keys() & two.images.keys())
    if len(common) < _LEAST_COMMON * max(len(one.images), len(two.images)):
        told = "; ".join(
            f"{len(names)} only in {root}: {listed(sorted(names))}"
            for root, names in ((first, one.images.keys() - common), (second, two.images.keys() - common))
            if names
        )
        raise ConfigError(
            f"{first} and {second} are workspaces of different images, {len(common)} have one name in both ({told}): "
            "compare two workspaces of the same images"
        )
    others = [name for name in common if not _same(one.images[name], two.images[name])]
    if others:
        raise ConfigError(
            f"{first} and {second} are workspaces of different images: those named "
            f"{listed(sorted(others))} have another size or time of capture in each; compare two workspaces of "
            "the same images"
        )


def _same(image: Image, other: Image) -> bool:
    """As far as tables tell: a copy of a file has other times of its own."""
    sizes = (image.width_px, image.height_px) == (other.width_px, other.height_px)
    return sizes and (not image.time or not other.time or image.time == other.time)


def _image_lines(one: _Side, two: _Side) -> Iterator[str]:
    yield _counts("images", len(one.images), len(two.images))
    for words, names in (
        ("only in the first", one.images.keys() - two.images.keys()),
        ("only in the second", two.images.keys() - one.images.keys()),
    ):
        if names:
            yield f"            {words}: {listed(sorted(names), MANY)}"


def _match_lines(one: _Side, two: _Side) -> Iterator[str]:
    verified = _verified(one), _verified(two)
    yield _counts("pairs", len(one.matches), len(two.matches))
    yield _counts("verified", len(verified[0]), len(verified[1]))
    for words, pairs in (("lost", verified[0] - verified[1]), ("gained", verified[1] - verified[0])):
        if pairs:
            named = listed((" and ".join(pair) for pair in sorted(pairs)), MANY, "; ")
            yield f"            {len(pairs)} {words}: {named}"
    yield _counts("matches", sum(one.matches.values()), sum(two.matches.values()))
    both = sorted(verified[0] & verified[1])
    ratios = [two.matches[pair] / one.matches[pair] for pair in both]
    if ratios:
        pairs_in_both = f"{counted(len(both), 'pair')} in both"
        yield f"            of {pairs_in_both}: {np.median(ratios):.2f} x as many (median)"


def _verified(side: _Side) -> set[tuple[str, str]]:
    return {pair for pair, count in side.matches.items() if count}


def _standing(side: _Side, common: Any) -> Standing:
    """common: names of the images in both."""
    adjusted, consistent = side.results.adjust, side.results.consistency
    control = None if adjusted is None else adjusted.control
    rmse_m = None if control is None else control.check_rmse_m
    spread = {} if consistent is None else consistent.spread
    names = {image.image_id: name for name, image in side.images.items()}
    frames = None if side.oriented is None else [frame for name, frame in side.oriented.items() if name in common]
    return Standing(
        verdict=side.verdict,
        oriented=None if frames is None else len(frames),
        georeferenced=None if frames is None else frames.count(_WORLD),
        check_m=None if rmse_m is None else float(np.linalg.norm(rmse_m)),
        checks=frozenset() if control is None else frozenset(control.checks),
        empty=sum(ninths.empty for i, ninths in spread.items() if names.get(i) in common) if spread else None,
        matches=sum(count for pair, count in side.matches.items() if common.issuperset(pair)),
        judged=side.judged,
    )


def _block_lines(one: AdjustResult | None, two: AdjustResult | None) -> Iterator[str]:
    """Figures of both final blocks; nothing where one has none."""
    if one is None or two is None:
        return
    yield _counts("oriented", one.images, two.images)
    yield _counts("points", one.points, two.points)
    if one.reprojection_error_px is not None and two.reprojection_error_px is not None:
        yield _counts("error px", one.reprojection_error_px, two.reprojection_error_px)


def _counts(words: str, first: float, second: float) -> str:
    change = ""
    if first and second != first:
        change = f" ({100.0 * (second / first - 1.0):+.1f} %)"
    return f"{words:<11} {_number(first)} and {_number(second)}{change}"


def _number(value: float) -> str:
    return f"{value:.2f}" if isinstance(value, float) else f"{value:,}"


def _side(root: Path) -> _Side:
    block = OpenedBlock(root)
    workspace = block.workspace
    results = results_of(workspace)
    quality = quality_of(results, block.names)
    return _Side(
        settings=load(str(workspace.config)).model_dump(mode="json"),
        images={image.name: image for image in block.images.values()},
        matches={(block.names[p.image_id0], block.names[p.image_id1]): _final_matches(block, p) for p in block.pairs},
        seconds=seconds_by_stage(workspace),
        results=results,
        oriented=_oriented(workspace),
        verdict=None if quality is None else quality.verdict,
        judged=_judged(workspace),
    )


def _judged(workspace: Workspace) -> Judged | None:
    found = present_evaluation(workspace)
    if found is None or found["totals"]["correctness"] is None:
        return None
    totals = found["totals"]
    return Judged(found["truth"], totals["correct"], 1.0 - totals["correctness"])


def _final_matches(block: OpenedBlock, pair: Pair) -> int:
    entry = block.final(pair)
    return len(entry.matches.indices) if entry is not None and entry.verdict.state == "verified" else 0


def _oriented(workspace: Workspace) -> dict[str, str] | None:
    path = workspace.orientation / "orientation.csv"
    if not path.is_file():
        return None
    return {row["image"]: row["frame"] for row in read_csv(path) if row["frame"] != _UNORIENTED}
