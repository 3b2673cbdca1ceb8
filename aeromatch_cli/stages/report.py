"""report: one HTML page of what is tied, what is not, and why; readable without network, printable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from aeromatch_cli import __version__
from aeromatch_cli.config import dump
from aeromatch_cli.data import FloatArray, Matches
from aeromatch_cli.errors import ItemError, WorkspaceError
from aeromatch_cli.formats import read_keypoints, read_match_row, read_verified_row
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.stages import report_figures as figures
from aeromatch_cli.stages import report_map
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import WEAK_MATCHES, components, match_points, summarise
from aeromatch_cli.stages.report_evaluation import evaluation_figures
from aeromatch_cli.stages.report_rows import NOT_JUDGED, ImageRow, PairRow, StageRow, failure_rows, gather, stage_rows
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.workspace import fingerprint, read_json, write_text

# Longer tables would make a page that no browser sorts: what is left out is the best, and it is in the files.
MAX_TABLE_ROWS = 2000
MAX_FAILURE_ROWS = 300
MAX_LISTED = 30
MAX_REJECTED_PREVIEWS = 2
_STATE_RANK = {"rejected": 0, "not verifiable": 1, NOT_JUDGED: 2}


@dataclass(frozen=True)
class Notice:
    """Something a person must see. level: "bad" or "warn". items: names, MAX_LISTED of them shown."""

    level: str
    title: str
    text: str
    items: tuple[str, ...] = ()


@dataclass(frozen=True)
class Preview:
    """A pair as a picture. svg: "" where it could not be made, then `note` says why."""

    heading: str
    pair: PairRow
    svg: str
    note: str


def run(context: Context) -> StageReport:
    """Write report/index.html. Raises WorkspaceError when a file of the workspace is broken."""
    report = StageReport("report", items=1)
    pairs, images = gather(context)
    page = render(context, pairs, images)
    write_text(context.workspace.report, page)
    report.done = 1
    report.fingerprint = fingerprint([vars(row) for row in pairs], [vars(row) for row in images])
    report.facts = {"page": "report/index.html", "bytes": len(page.encode("utf-8"))}
    return report.write(context.workspace)


def render(context: Context, pairs: Sequence[PairRow], images: Sequence[ImageRow]) -> str:
    """The page as text."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["number"] = number
    source = resources.files("aeromatch_cli.stages") / "report.html.jinja"
    template = environment.from_string(source.read_text(encoding="utf-8"))
    facts = summarise(context, components(context))
    contradictions = _contradictions(context)
    failures = failure_rows(context)
    remarks = _remarks(context)
    verified = [row for row in pairs if row.state == "verified"]
    stages = stage_rows(context.workspace)
    return template.render(
        version=__version__,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        title=PurePosixPath(context.workspace.root.as_posix()).name,
        headline=_headline(images, pairs, facts, failures),
        notices=notices(images, pairs, facts, contradictions, remarks["warnings"]),
        max_listed=MAX_LISTED,
        failures=failures[:MAX_FAILURE_ROWS],
        failure_count=len(failures),
        summary=remarks["summary"],
        block=_block_facts(context),
        map=_map(context, images, pairs, contradictions),
        pair_histogram=_histogram([row.verified for row in verified], "verified matches per verified pair", "pairs"),
        image_histogram=_histogram([row.verified_matches for row in images], "verified matches per image", "images"),
        evaluation=evaluation_figures(context.workspace),
        previews=_previews(context, pairs),
        error_limits_px=figures.ERROR_LIMITS_PX,
        pairs=_worst_pairs(pairs),
        pair_count=len(pairs),
        images=sorted(images, key=lambda row: (row.verified_matches, row.image_id))[:MAX_TABLE_ROWS],
        image_count=len(images),
        weak_matches=WEAK_MATCHES,
        contradictions=contradictions,
        stages=stages,
        longest_seconds=max((row.seconds for row in stages), default=0.0),
        total=StageRow("sum", sum(row.seconds for row in stages), 0, 0, 0, sum(row.failed for row in stages), ""),
        settings=_settings_text(context),
    )


def number(value: float | None, digits: int = 0, factor: float = 1.0) -> str:
    """Thousands separated by commas; an empty cell where unknown."""
    return "" if value is None or math.isnan(value) else f"{value * factor:,.{digits}f}"


def _headline(
    images: Sequence[ImageRow], pairs: Sequence[PairRow], facts: Mapping[str, Any], failures: Sequence[Any]
) -> list[tuple[str, str, str]]:
    """(number, words, level) of each tile; level "" or "bad"."""
    posed = sum(row.pose != "none" for row in images)
    full = sum(row.pose == "full" for row in images)
    verified = sum(row.state == "verified" for row in pairs)
    parts, weak = len(facts["components"]), len(facts["weakly_tied"])
    return [
        (f"{len(images):,}", "images", ""),
        (f"{posed:,}", f"with position, {full:,} with attitude", ""),
        (f"{len(pairs):,}", "pairs compared", ""),
        (f"{verified:,}", "verified pairs", "" if verified else "bad"),
        (f"{facts['verified_matches']:,}", "verified matches", "" if verified else "bad"),
        (f"{parts:,}", "connected group" if parts == 1 else "unconnected groups", "bad" if parts > 1 else ""),
        (f"{weak:,}", f"weakly tied images (< {WEAK_MATCHES} matches)", "bad" if weak else ""),
        (f"{len(failures):,}", "failure" if len(failures) == 1 else "failures", "bad" if failures else ""),
    ]


def notices(
    images: Sequence[ImageRow],
    pairs: Sequence[PairRow],
    facts: Mapping[str, Any],
    contradictions: Mapping[str, float],
    warnings: Sequence[str],
) -> list[Notice]:
    """What needs a person's eye, the gravest first."""
    found = []
    names = {row.image_id: row.name for row in images}
    if not facts["verified_matches"]:
        found.append(Notice("bad", "No pair is verified", "The block has no tie points; the pair table says why."))
    elif len(facts["components"]) > 1:
        sizes, alone = facts["components"], sum(size == 1 for size in facts["components"])
        shown = ", ".join(f"{size:,}" for size in sizes[:12] if size > 1)
        text = f"Sizes of the groups with more than one image: {shown}. Images tied to no other: {alone:,}."
        found.append(Notice("bad", f"The block falls into {len(sizes):,} unconnected groups of images", text))
    if contradictions:
        text = "Matches say that these attitudes are wrong by the angle given; only their positions are used."
        items = tuple(f"{names.get(i, i)}: {angle:.1f}°" for i, angle in contradictions.items())
        title = _counted(len(items), "attitude contradicts the pictures", "attitudes contradict the pictures")
        found.append(Notice("bad", title, text, items))
    if facts["weakly_tied"] and facts["verified_matches"]:
        ties = {row.image_id: row for row in images}
        items = tuple(f"{names[i]} ({ties[i].verified_matches})" for i in facts["weakly_tied"])
        text = f"Fewer than {WEAK_MATCHES} verified matches over all their pairs (their number in brackets)."
        title = _counted(len(items), "image is weakly tied", "images are weakly tied")
        found.append(Notice("bad", title, text, items))
    for pose, lacks, text in (
        ("none", "no position", "Paired by name or time, and not on the map."),
        ("position", "no usable attitude", "Paired by position, and without footprint."),
    ):
        items = tuple(row.name for row in images if row.pose == pose and row.image_id not in contradictions)
        if items:
            title = _counted(len(items), f"image has {lacks}", f"images have {lacks}")
            found.append(Notice("warn", title, text, items))
    lost = sum(row.state == NOT_JUDGED for row in pairs)
    if lost:
        text = "No matches on file: the match stage failed there or has not run."
        found.append(Notice("warn", _counted(lost, "pair was not judged", "pairs were not judged"), text))
    found += [Notice("warn", "Remark on the input", warning) for warning in warnings]
    return found


def _counted(count: int, one: str, several: str) -> str:
    return f"{count:,} {one if count == 1 else several}"


def _remarks(context: Context) -> dict[str, list[str]]:
    """Summary lines and warnings of the input, as the pairs stage left them."""
    path = context.workspace.stage_report("pairs")
    facts = read_json(path)["facts"] if path.is_file() else {}
    return {key: [str(line) for line in facts.get(key, [])] for key in ("summary", "warnings")}


def _contradictions(context: Context) -> dict[str, float]:
    """image_id -> degrees between its attitude and its matches, as the filter stage found them."""
    path = context.workspace.stage_report("filter")
    facts = read_json(path)["facts"] if path.is_file() else {}
    return {str(i): float(angle) for i, angle in facts.get("rotation_contradicts_pose", {}).items()}


def _block_facts(context: Context) -> list[tuple[str, str]]:
    block = context.block
    cameras = []
    for camera_id, camera in sorted(block.cameras.items()):
        params = ", ".join(f"{value:g}" for value in camera.params)
        cameras.append(f"{camera_id}: {camera.model}, {camera.width_px} x {camera.height_px} px, {params}")
    more = [f"and {len(cameras) - 10} more"] if len(cameras) > 10 else []
    return [
        ("World frame", f"{block.crs}, minus the origin {' / '.join(f'{value:,.0f}' for value in block.origin_m)}"),
        ("Ground", block.ground_source),
        ("Ground sampling distance", "unknown" if block.gsd_m is None else f"{block.gsd_m:.3g} m"),
        ("Cameras", "\n".join(cameras[:10] + more)),
        ("Images in", context.settings.block.images),
    ]


def _settings_text(context: Context) -> str:
    path = context.workspace.config
    return path.read_text(encoding="utf-8") if path.is_file() else dump(context.settings)


def _histogram(values: Sequence[int], label: str, unit: str) -> str:
    return figures.histogram(values, label, unit) if values else ""


def _map(
    context: Context, images: Sequence[ImageRow], pairs: Sequence[PairRow], contradictions: Mapping[str, float]
) -> report_map.MapFigure | None:
    """None where no image has a position."""
    labels = _labels([row.name for row in images])
    stations = []
    for row, label in zip(images, labels, strict=True):
        pose = context.pose(row.image_id)
        if pose is None or not np.isfinite(pose.center_m).all():
            continue
        x, y, z = (float(value) for value in pose.center_m)
        ties = f"{row.verified_matches:,} verified matches in {row.verified_pairs} of {row.pairs} pairs"
        title = f"{row.name}: {ties}, z {z:.1f} m"
        weak = row.verified_matches < WEAK_MATCHES
        stations.append(report_map.Station(row.image_id, label, title, x, y, weak, row.image_id in contradictions))
    if not stations:
        return None
    footprints = [footprint.polygon_m for footprint in block_footprints(context.block).values()]
    return report_map.block_map(stations, footprints, [_link(row) for row in pairs])


def _link(row: PairRow) -> report_map.Link:
    words = f"{row.verified:,} verified matches" if row.state == "verified" else f"{row.state}: {row.reason}"
    title = f"{row.name0} – {row.name1}: {words}"
    return report_map.Link(row.image_id0, row.image_id1, row.state, row.verified, title)


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
    """At most MAX_TABLE_ROWS: refused pairs from large overlap down, then verified ones from few matches up."""
    refused = [row for row in pairs if row.state != "verified"]
    verified = sorted((row for row in pairs if row.state == "verified"), key=lambda row: row.verified)
    refused.sort(key=lambda row: (_STATE_RANK[row.state], -np.nan_to_num(row.overlap)))
    shown = refused[: max(MAX_TABLE_ROWS // 2, MAX_TABLE_ROWS - len(verified))]
    return shown + verified[: MAX_TABLE_ROWS - len(shown)]


# --- previews ---------------------------------------------------------------------------------------------------


def chosen_previews(pairs: Sequence[PairRow]) -> list[tuple[str, PairRow]]:
    """Best, median and worst verified pair by matches, and the rejected pairs that had most matches."""
    verified = sorted((row for row in pairs if row.state == "verified"), key=lambda row: row.verified)
    chosen: dict[int, str] = {}
    if verified:
        for index, words in ((len(verified) - 1, "Best"), (len(verified) // 2, "Median"), (0, "Worst")):
            chosen.setdefault(index, f"{words} verified pair")
    result = [(heading, verified[index]) for index, heading in chosen.items()]
    rejected = sorted((row for row in pairs if row.state == "rejected"), key=lambda row: -row.matches_in)
    return result + [("Rejected pair", row) for row in rejected[:MAX_REJECTED_PREVIEWS]]


def _previews(context: Context, pairs: Sequence[PairRow]) -> list[Preview]:
    previews = []
    for heading, row in chosen_previews(pairs):
        try:
            svg, note = _preview(context, row), ""
        except (ItemError, WorkspaceError) as error:
            svg, note = "", f"no preview: {error}"
        previews.append(Preview(heading, row, svg, note))
    return previews


def _preview(context: Context, row: PairRow) -> str:
    """Verified matches with their errors, or, of a refused pair, the matches that it came with."""
    workspace, ids = context.workspace, (row.image_id0, row.image_id1)
    matches: Matches | None = None
    errors: FloatArray | None = None
    if row.state == "verified":
        path = workspace.verified(ids[0])
        if (entry := read_verified_row(path).get(ids[1])) is not None:
            matches, errors = entry.matches, entry.verdict.errors_px
    else:
        path = workspace.matches(ids[0])
        if (raw := read_match_row(path).get(ids[1])) is not None:
            matches = raw.matches
    if matches is None:
        raise WorkspaceError(f"{path} does not hold the pair; run the stage that makes it again")
    points = match_points(matches, *(read_keypoints(workspace.features(i))[0] for i in ids))
    sides = []
    for image_id, points_px in zip(ids, points, strict=True):
        image = context.image_by_id[image_id]
        pixels = read_pixels(context.image_path(image), colour=True)
        sides.append(figures.Side(pixels, image.exif_orientation, points_px))
    return figures.preview(sides[0], sides[1], errors, f"Matches of {row.name0} and {row.name1}")
