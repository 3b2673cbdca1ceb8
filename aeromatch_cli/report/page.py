"""report: the HTML page, from the rows, figures and settings of a workspace."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli import __version__
from aeromatch_cli.config import dump
from aeromatch_cli.data import AdjustedBlock, PoseResidual
from aeromatch_cli.files import write_text
from aeromatch_cli.fingerprints import file_digest, fingerprint
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.report.adjustment import (
    PRINCIPAL_POINT,
    Adjustment,
    Notice,
    adjusted_poses,
    adjustment_notices,
    adjustment_rows,
    as_adjusted,
    camera_words,
    final_points,
    images_aside,
    read_adjustment,
    surveyed_rows,
)
from aeromatch_cli.report.calibration import CameraSection, camera_sections, heights_sections
from aeromatch_cli.report.figures import COLOURS, histogram
from aeromatch_cli.report.gathering import Gathered, gather, settled
from aeromatch_cli.report.map import Link, MapFigure, Station, block_map
from aeromatch_cli.report.pair_viewer import pair_data, pair_table
from aeromatch_cli.report.places import ground_figures, point_figures
from aeromatch_cli.report.previews import ERROR_LIMITS_PX, previews
from aeromatch_cli.report.residuals import residual_section
from aeromatch_cli.report.rows import (
    NOT_JUDGED,
    OWN_FRAME,
    ImageRow,
    PairRow,
    evaluation_figures,
    failure_rows,
    stage_rows,
)
from aeromatch_cli.report.sketch import ground_sketch
from aeromatch_cli.report.thumbnails import thumbnails
from aeromatch_cli.results.stages import FilterResult, MatchResult, OrientResult, PairsResult, ReportResult
from aeromatch_cli.sfm.quality.finding import Finding, Quality, plain
from aeromatch_cli.stages.contents import contents_of, residuals_of_points
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import WEAK_MATCHES, connection
from aeromatch_cli.stages.messages import settled_words
from aeromatch_cli.stages.quality import quality_on_file
from aeromatch_cli.stages.stage_report import StageReport, result_on_file
from aeromatch_cli.words import counted
from aeromatch_cli.workspace import Workspace

# Longer tables would make a page that no browser sorts: what is left out is the best, and it is in the files.
MAX_TABLE_ROWS = 2000
MAX_FAILURE_ROWS = 300
MAX_LISTED = 30
_STATE_RANK = {"rejected": 0, "not verifiable": 1, NOT_JUDGED: 2}


def run(context: Context) -> StageReport:
    """Write report/index.html. Raises WorkspaceError when a file of the workspace is broken."""
    report = StageReport("report", items=1, fingerprint=_told_fingerprint(context.workspace))
    results = _told_fingerprint(context.workspace, settings=False)
    adjustment = read_adjustment(context)
    adjusted = final_points(context, adjustment)
    shown = as_adjusted(context.block, adjusted, in_world=adjustment.in_world)
    # Rows state of every image whether it has a pose, in whatever frame.
    poses = context.block.poses if adjusted is None else {**shown.poses, **adjusted_poses(adjusted)}
    own_frame = images_aside(context.block, adjusted, in_world=True)
    found = gather(
        context, pair_table, adjustment.judged.spread, poses, own_frame if adjustment.in_world else poses.keys()
    )
    with settled():
        page = render(context, found, adjustment, adjusted)
    write_text(context.workspace.report, page)
    report.record_files(context, (p for p in context.workspace.report.parent.rglob("*") if p.is_file()))
    report.done = 1
    report.result = ReportResult(page="report/index.html", bytes=len(page.encode("utf-8")), of_results=results)
    return report.write(context.workspace)


def page_if_up_to_date(context: Context) -> StageReport | None:
    """Return the report of the page on file, where everything that it tells of is as it was when it was written."""
    report = StageReport("report", items=1, fingerprint=_told_fingerprint(context.workspace))
    return report if report.take_if_up_to_date(context) else None


def is_of_earlier_results(workspace: Workspace) -> bool:
    """Whether the page on file tells of results that are no longer there. Settings do not count: a run without the page
    has others than one with it."""
    page = result_on_file(workspace, ReportResult)
    return workspace.report.is_file() and (
        page is None or page.of_results != _told_fingerprint(workspace, settings=False)
    )


def _told_fingerprint(workspace: Workspace, *, settings: bool = True) -> str:
    """Return the fingerprint of the files that a page tells of. Times of files would not do to see that they are as
    they were: clocks are set back, and a folder's server has its own. settings: whether the list of settings is one of
    them."""
    told = [path for path in workspace.reports.glob("*.json") if path != workspace.stage_report("report")]
    told += [workspace.block, workspace.images, workspace.poses, workspace.pairs, workspace.failures]
    told += [workspace.config] if settings else []
    return fingerprint([(path.name, file_digest(path)) for path in sorted(told) if path.is_file()])


def render(context: Context, found: Gathered, adjustment: Adjustment, adjusted: AdjustedBlock | None = None) -> str:
    """The page as text. adjusted: the adjusted block with its final points."""
    pairs, images = found.pairs, found.images
    judged = (row for row in pairs if row.state != NOT_JUDGED)
    links = connection(context, ((row.image_id0, row.image_id1, row.state, row.verified) for row in judged))
    oriented = result_on_file(context.workspace, OrientResult)
    wrong = {} if oriented is None else oriented.wrong_attitudes
    block = result_on_file(context.workspace, PairsResult)
    # Not that of the views, which is of images in frames of their own, too.
    gsd_m = None if block is None else block.block.gsd_m
    matched = result_on_file(context.workspace, MatchResult)
    control = adjustment.found.control
    failures = failure_rows(context)
    stages = stage_rows(context.workspace)
    # Without a verified pair what is on file is of other keypoints.
    adjusted = adjusted if any(row.state == "verified" for row in pairs) else None
    placed = replace(context, block=as_adjusted(context.block, adjusted, in_world=adjustment.in_world))
    aside = images_aside(context.block, adjusted, in_world=adjustment.in_world)
    quality = _quality(context, adjustment)
    shown = _worst_pairs(pairs)
    pictures = thumbnails(context)
    drawn, keys = pair_data(context, pairs, pictures, found.drawn)
    drawn.write_beside(context.workspace.report.parent / "pairs")
    return _template().render(
        version=__version__,
        principal_point=PRINCIPAL_POINT,
        colours=COLOURS,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        title=PurePosixPath(context.workspace.root.as_posix()).name,
        quality=quality,
        headline=[*_verdict(quality), *_headline(images, pairs, links, failures)],
        notices=_gravest_first(
            notices(images, pairs, links, oriented), adjustment_notices(images, adjustment), _input_notices(block)
        ),
        max_listed=MAX_LISTED,
        failures=failures[:MAX_FAILURE_ROWS],
        failure_count=len(failures),
        summary=[] if block is None else block.summary,
        adjusted=adjustment_rows(adjustment),
        positions=None
        if adjusted is None
        else residual_section(
            adjusted,
            _residuals(context, adjusted),
            {row.image_id: row.name for row in images},
            gsd_m,
            adjustment.found.groups,
        ),
        cameras=_cameras(context, adjustment, adjusted),
        readout_not_tried=adjustment.found.readout_not_tried,
        heights=heights_sections(adjustment.found, {row.image_id: row.name for row in images}),
        residuals=surveyed_rows(control),
        residuals_after_fit=control is not None and control.transformation is not None,
        block=_block_facts(context, gsd_m, in_world=adjustment.in_world),
        map=_map(placed, images, pairs, wrong, pictures, aside, in_world=adjustment.in_world),
        fields=_ground_figures(placed, adjusted, in_world=adjustment.in_world),
        histograms=[*_histograms(images, pairs), *point_figures(adjusted)],
        evaluation=evaluation_figures(context.workspace),
        previews=previews(context, pairs),
        error_limits_px=ERROR_LIMITS_PX,
        pairs=shown,
        pair_data=drawn.text(),
        pair_keys=keys,
        pairs_beside=bool(drawn.beside),
        has_steps=any(row.steps for row in pairs),
        settled="" if matched is None else settled_words(matched),
        pair_count=len(pairs),
        images=sorted(images, key=lambda row: (row.verified_matches, row.image_id))[:MAX_TABLE_ROWS],
        image_count=len(images),
        weak_matches=WEAK_MATCHES,
        unread=links.unread,
        wrong=wrong,
        stages=stages,
        settings=_settings_text(context),
    )


def _histograms(images: Sequence[ImageRow], pairs: Sequence[PairRow]) -> list[str]:
    """Draw how many verified matches pairs and images have; nothing where none has any."""
    of_pairs = [row.verified for row in pairs if row.state == "verified"]
    of_images = [row.verified_matches for row in images]
    figures = []
    if any(of_pairs):
        figures.append(histogram(of_pairs, "verified matches per verified pair", "pairs"))
    if any(of_images):
        figures.append(histogram(of_images, "verified matches per image", "images"))
    return figures


def _quality(context: Context, adjustment: Adjustment) -> Quality | None:
    """None where the adjustment on file is of earlier matches."""
    if adjustment.outdated:
        return None
    return quality_on_file(context.workspace, context.block.names)


def _verdict(quality: Quality | None) -> list[tuple[str, str, str]]:
    """The first tile: the verdict and the gravest finding, with its number."""
    if quality is None:
        return []
    level = {"good": "", "doubtful": "warn", "bad": "bad"}[quality.verdict]
    if not quality.faults:
        return [(quality.verdict, "result: nothing speaks against the block", level)]
    first = quality.faults[0]
    return [(quality.verdict, f"result: {first.what}{_figure(first)}", level)]


def _figure(finding: Finding) -> str:
    """With its limit, where there are numbers."""
    if finding.value is None or not math.isfinite(finding.value):
        return ""
    limit = "" if finding.limit is None else f" (limit {plain(finding.limit)})"
    return f" {plain(finding.value)}{limit}"


def _cameras(context: Context, adjustment: Adjustment, adjusted: AdjustedBlock | None) -> list[CameraSection]:
    if adjusted is None:
        return []
    seen_px = contents_of(context, adjusted, raw=False).keypoints_px
    return camera_sections(adjustment.found, adjusted, context.block.images, seen_px)


def _residuals(context: Context, adjusted: AdjustedBlock | None) -> dict[str, PoseResidual]:
    """By image_id; none of earlier matches."""
    return {} if adjusted is None else residuals_of_points(contents_of(context, adjusted, raw=False))


def number(value: float | None, digits: int = 0, factor: float = 1.0) -> str:
    """Thousands separated by commas; an empty cell where unknown."""
    return "" if value is None or math.isnan(value) else f"{value * factor:,.{digits}f}"


def _headline(
    images: Sequence[ImageRow], pairs: Sequence[PairRow], links: FilterResult, failures: Sequence[Any]
) -> list[tuple[str, str, str]]:
    """(number, words, level) of each tile; level "", "warn" or "bad"."""
    poses = Counter(row.pose for row in images)
    own_frame = f"; {poses[OWN_FRAME]:,} oriented in a frame of their own" if poses[OWN_FRAME] else ""
    verified = sum(row.state == "verified" for row in pairs)
    matches, parts, weak = links.verified_matches, len(links.components), len(links.weakly_tied)
    tiles = [
        (counted(len(images), "image", "images"), False),
        (
            f"{poses['full'] + poses['position']:,} with position, {poses['full']:,} with attitude, given or found"
            + own_frame,
            False,
        ),
        (counted(len(pairs), "pair compared", "pairs compared"), False),
        (counted(verified, "verified pair", "verified pairs"), not verified),
        (counted(matches, "verified match", "verified matches"), not matches),
        (counted(parts, "connected group", "unconnected groups"), parts > 1),
        (counted(weak, "weakly tied image", "weakly tied images") + f" (< {WEAK_MATCHES} matches)", weak > 0),
        (counted(len(failures), "failure", "failures"), bool(failures)),
    ]
    parted = [(text.partition(" "), bad) for text, bad in tiles]
    return [(count, words, "bad" if bad else "") for (count, _, words), bad in parted]


def _gravest_first(*found: Iterable[Notice]) -> list[Notice]:
    return sorted((notice for one in found for notice in one), key=lambda notice: notice.level != "bad")


def _input_notices(block: PairsResult | None) -> list[Notice]:
    if block is None:
        return []
    text = "`aeromatch run` without --within makes the rest."
    left = [Notice("warn", "Reduced to end in time", text, tuple(block.left_out))] if block.left_out else []
    return [*left, *(Notice("warn", "Note on the input", warning) for warning in block.warnings)]


def _orientation_notices(oriented: OrientResult, names: Mapping[str, str]) -> Iterator[Notice]:
    """What of that which was given is wrong."""
    used = "the given one is kept" if oriented.stays else "the one from the pictures is used"
    wrong = (oriented.wrong_attitudes, "attitude", "°"), (oriented.wrong_positions, "position", " m")
    for off_by_image, what, unit in wrong:
        items = tuple(f"{names.get(i, i)}: {off:.1f}{unit}" for i, off in off_by_image.items())
        if items:
            text = f"The pictures contradict the given {what} by what is shown; {used}."
            yield Notice("bad", counted(len(items), f"wrong {what}", f"wrong {what}s"), text, items)
    tied = tuple(names.get(i, i) for i in (*oriented.by_one_pair, *oriented.by_ground))
    if tied:
        title = counted(len(tied), "image hangs on a single pair", "images hang on a single pair each")
        text = (
            "A pair tells the direction to an image and not how far off it lies; the given position or the height of "
            "the ground beside does, less exactly than points of three images would."
        )
        yield Notice("warn", title, text, tied)
    for camera_id, focal in oriented.focal_lengths.items():
        text = f"Camera {camera_id}: {focal.found_px:.0f} px in the pictures, {focal.given_px:.0f} px before; {used}."
        yield Notice("warn", "Another focal length", text)


def notices(
    images: Sequence[ImageRow],
    pairs: Sequence[PairRow],
    links: FilterResult,
    oriented: OrientResult | None,
) -> list[Notice]:
    """What needs a person's eye of pairs, images and the orientation. links: how verified matches connect images."""
    found = []
    names = {row.image_id: row.name for row in images}
    if not links.verified_matches:
        found.append(Notice("bad", "No pair is verified", "The block has no tie points; the pair table says why."))
    elif len(links.components) > 1:
        sizes, alone = links.components, sum(size == 1 for size in links.components)
        shown = ", ".join(f"{size:,}" for size in sizes[:12] if size > 1)
        text = f"Sizes of the groups with more than one image: {shown}. Images tied to no other: {alone:,}."
        found.append(Notice("bad", f"The block falls into {len(sizes):,} unconnected groups of images", text))
    if links.unread:
        title = counted(len(links.unread), "image could not be read", "images could not be read")
        text = "Replace or remove the files and run again; failures.csv says why."
        found.append(Notice("bad", title, text, tuple(names[i] for i in links.unread)))
    found += [] if oriented is None else _orientation_notices(oriented, names)
    if links.weakly_tied and links.verified_matches:
        ties = {row.image_id: row for row in images}
        items = tuple(f"{names[i]} ({ties[i].verified_matches})" for i in links.weakly_tied)
        text = f"Fewer than {WEAK_MATCHES} verified matches in all pairs together (number in brackets)."
        title = counted(len(items), "image is weakly tied", "images are weakly tied")
        found.append(Notice("bad", title, text, items))
    for pose, lacks, text in (
        ("none", "no position", "They are paired by name, time or looks, and are not on the map."),
        ("position", "no usable attitude", "They are paired by position, and drawn without footprint."),
    ):
        items = tuple(row.name for row in images if row.pose == pose)
        if items:
            title = counted(len(items), f"image has {lacks}", f"images have {lacks}")
            found.append(Notice("warn", title, text, items))
    lost = sum(row.state == NOT_JUDGED for row in pairs)
    if lost:
        text = (
            "No matches of the present keypoints are on file: the match stage failed there, or keypoints were found "
            "again since. Run aeromatch match and then aeromatch filter, or aeromatch run."
        )
        found.append(Notice("warn", counted(lost, "pair was not judged", "pairs were not judged"), text))
    return found


def _block_facts(context: Context, gsd_m: float | None, *, in_world: bool) -> list[tuple[str, str]]:
    """gsd_m: ground sampling distance in metres, None where it is not known."""
    block = context.block
    frame = f"{block.crs}, minus the origin {' / '.join(f'{value:,.0f}' for value in block.origin_m)}"
    return [
        ("World frame", frame if in_world else "the pictures' own: scale, north and place are arbitrary"),
        ("Ground", block.ground_source),
        ("Ground sampling distance", "unknown" if gsd_m is None else f"{gsd_m:.3g} m"),
        (f"Cameras ({PRINCIPAL_POINT})", camera_words(block.cameras)),
        ("Images in", context.settings.block.images),
    ]


def _template() -> Any:
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["number"] = number
    source = resources.files("aeromatch_cli.report") / "page.html.jinja"
    return environment.from_string(source.read_text(encoding="utf-8"))


def _settings_text(context: Context) -> str:
    path = context.workspace.config
    return path.read_text(encoding="utf-8") if path.is_file() else dump(context.settings)


def _ground_figures(context: Context, adjusted: AdjustedBlock | None, *, in_world: bool) -> list[tuple[str, str]]:
    footprints = [footprint.polygon_m for footprint in block_footprints(context.block).values()]
    centers = np.array([pose.center_m[:2] for pose in context.block.poses.values()]).reshape(-1, 2)
    return ground_figures(centers[np.isfinite(centers).all(axis=1)], footprints, adjusted, in_world=in_world)


def _map(
    context: Context,
    images: Sequence[ImageRow],
    pairs: Sequence[PairRow],
    wrong: Mapping[str, float],
    pictures: Mapping[str, NDArray[np.uint8]],
    aside: frozenset[str],
    *,
    in_world: bool,
) -> MapFigure | None:
    """None where no image has a position. pictures: reduced ones, for the sketch of the ground. aside: images of groups
    that lie in frames of their own."""
    stations = []
    for row, label in zip(images, _labels([row.name for row in images]), strict=True):
        pose = context.pose(row.image_id)
        if pose is None or not np.isfinite(pose.center_m).all():
            continue
        x, y, z = (float(value) for value in pose.center_m)
        ties = counted(row.verified_matches, "verified match", "verified matches")
        height = f", z {z:.1f} m" if in_world else ""
        title = f"{row.name}: {ties} in {row.verified_pairs} of {counted(row.pairs, 'pair', 'pairs')}{height}"
        weak = "weak" if row.verified_matches < WEAK_MATCHES else "fine"
        stations.append(Station(row.image_id, label, title, x, y, "wrong" if row.image_id in wrong else weak))
    if not stations:
        return None
    footprints = [footprint.polygon_m for footprint in block_footprints(context.block).values()]
    sketch = partial(ground_sketch, context, pictures)
    links = [_link(row) for row in pairs]
    return block_map(stations, footprints, links, in_world=in_world, aside=aside, sketch=sketch)


def _link(row: PairRow) -> Link:
    verified = counted(row.verified, "verified match", "verified matches")
    words = verified if row.state == "verified" else f"{row.state}: {row.reason}"
    return Link(row.image_id0, row.image_id1, row.state, row.verified, f"{row.name0} – {row.name1}: {words}")


def _labels(names: Sequence[str]) -> list[str]:
    """Short names for the map: without suffix and without what all names begin with, up to their last separator."""
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    common = 0
    if len(stems) > 1:
        first, last = min(stems), max(stems)
        while common < min(len(first), len(last)) and first[common] == last[common]:
            common += 1
        common = max(first.rfind(mark, 0, common) for mark in "_-/ .") + 1
    return [stem[common:] or stem for stem in stems]


def _worst_pairs(pairs: Sequence[PairRow]) -> list[PairRow]:
    """At most MAX_TABLE_ROWS: other pairs from large overlap down, then verified ones from few matches up."""
    others = [row for row in pairs if row.state != "verified"]
    verified = sorted((row for row in pairs if row.state == "verified"), key=lambda row: row.verified)
    others.sort(key=lambda row: (_STATE_RANK[row.state], -np.nan_to_num(row.overlap)))
    shown = others[: max(MAX_TABLE_ROWS // 2, MAX_TABLE_ROWS - len(verified))]
    return shown + verified[: MAX_TABLE_ROWS - len(shown)]
