"""report: the HTML page, from the rows, figures and settings of a workspace."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli import __version__
from aeromatch_cli.config import dump
from aeromatch_cli.data import AdjustedBlock, Camera
from aeromatch_cli.files import read_json, write_record, write_text
from aeromatch_cli.fingerprints import file_digest, fingerprint
from aeromatch_cli.formats.adjusted import read_adjusted
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.orientation.control import offset_words
from aeromatch_cli.report.figures import COLOURS, histogram
from aeromatch_cli.report.gathering import Gathered, gather, settled
from aeromatch_cli.report.map import Link, MapFigure, Station, block_map
from aeromatch_cli.report.pair_viewer import pair_data, pair_table
from aeromatch_cli.report.places import ground_figures, point_figures
from aeromatch_cli.report.previews import ERROR_LIMITS_PX, previews
from aeromatch_cli.report.rows import (
    NOT_JUDGED,
    ImageRow,
    PairRow,
    evaluation_figures,
    failure_rows,
    stage_rows,
)
from aeromatch_cli.report.sketch import ground_sketch
from aeromatch_cli.report.thumbnails import thumbnails
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import WEAK_MATCHES, summarise
from aeromatch_cli.stages.lines import settled_words
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.workspace import Workspace

# Longer tables would make a page that no browser sorts: what is left out is the best, and it is in the files.
MAX_TABLE_ROWS = 2000
MAX_FAILURE_ROWS = 300
MAX_LISTED = 30
# Of adjusted poses: the facts of the stage adjust, and their units.
_SIGMAS = (("sigma_position_m", "m"), ("sigma_angle_deg", "degrees"))
_STATE_RANK = {"rejected": 0, "not verifiable": 1, NOT_JUDGED: 2}


@dataclass(frozen=True)
class Notice:
    """Something a person must see. level: "bad" or "warn". items: names, MAX_LISTED of them shown."""

    level: str
    title: str
    text: str
    items: tuple[str, ...] = ()


def run(context: Context) -> StageReport:
    """Write report/index.html. Raises WorkspaceError when a file of the workspace is broken."""
    report, told = StageReport("report", items=1), told_digests(context.workspace)
    found = gather(context, pair_table)
    pairs, images = found.pairs, found.images
    with settled():
        page = render(context, found)
    write_text(context.workspace.report, page)
    record = context.workspace.report_files
    folder = record.parent
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and path != record)
    write_record(record, {"told": told}, names)
    report.done = 1
    report.fingerprint = fingerprint([vars(row) for row in pairs], [vars(row) for row in images])
    report.facts = {"page": "report/index.html", "bytes": len(page.encode("utf-8"))}
    return report.write(context.workspace)


def told_digests(workspace: Workspace) -> dict[str, str]:
    """Digests of the files that a page tells of, by their names in the workspace. Times of files would not do to see
    that they are as they were: clocks are set back, and a folder's server has its own."""
    told = [path for path in workspace.reports.glob("*.json") if path != workspace.stage_report("report")]
    told += [workspace.block, workspace.images, workspace.poses, workspace.pairs, workspace.failures, workspace.config]
    return {p.relative_to(workspace.root).as_posix(): file_digest(p) for p in sorted(told) if p.is_file()}


def render(context: Context, found: Gathered) -> str:
    """The page as text."""
    pairs, images = found.pairs, found.images
    judged = (row for row in pairs if row.state != NOT_JUDGED)
    facts = summarise(context, ((row.image_id0, row.image_id1, row.state, row.verified) for row in judged))
    wrong = {i: float(angle) for i, angle in _facts(context, "orient").get("wrong_attitudes", {}).items()}
    input_facts = _facts(context, "pairs")
    failures = failure_rows(context)
    stages = stage_rows(context.workspace)
    # Without a verified pair what is on file is of other keypoints.
    adjusted = _adjusted_block(context) if any(row.state == "verified" for row in pairs) else None
    shown = _worst_pairs(pairs)
    pictures = thumbnails(context)
    drawn, keys = pair_data(context, pairs, pictures, found.drawn)
    drawn.write_beside(context.workspace.report.parent / "pairs")
    return _template().render(
        version=__version__,
        colours=COLOURS,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        title=PurePosixPath(context.workspace.root.as_posix()).name,
        headline=_headline(images, pairs, facts, failures),
        notices=_all_notices(context, images, pairs, facts, input_facts.get("warnings", [])),
        max_listed=MAX_LISTED,
        failures=failures[:MAX_FAILURE_ROWS],
        failure_count=len(failures),
        summary=input_facts.get("summary", []),
        adjusted=_adjusted_facts(_facts(context, "adjust")),
        residuals=(_facts(context, "adjust").get("control") or {}).get("residuals", {}),
        block=_block_facts(context),
        map=_map(context, images, pairs, wrong, pictures),
        fields=_ground_figures(context, adjusted),
        histograms=[
            histogram(counts, f"verified matches per {words}", unit)
            for counts, words, unit in (
                ([row.verified for row in pairs if row.state == "verified"], "verified pair", "pairs"),
                ([row.verified_matches for row in images], "image", "images"),
            )
            if any(counts)
        ]
        + point_figures(adjusted),
        evaluation=evaluation_figures(context.workspace),
        previews=previews(context, pairs),
        error_limits_px=ERROR_LIMITS_PX,
        pairs=shown,
        pair_data=drawn.text(),
        pair_keys=keys,
        pairs_beside=bool(drawn.beside),
        has_steps=any(row.steps for row in pairs),
        settled=settled_words(matched) if "settled_by" in (matched := _facts(context, "match")) else "",
        pair_count=len(pairs),
        images=sorted(images, key=lambda row: (row.verified_matches, row.image_id))[:MAX_TABLE_ROWS],
        image_count=len(images),
        weak_matches=WEAK_MATCHES,
        wrong=wrong,
        stages=stages,
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
    matches, parts, weak = facts["verified_matches"], len(facts["components"]), len(facts["weakly_tied"])
    tiles = [
        (_counted(len(images), "image", "images"), False),
        (f"{posed:,} with position, {full:,} with attitude, given or found", False),
        (_counted(len(pairs), "pair compared", "pairs compared"), False),
        (_counted(verified, "verified pair", "verified pairs"), not verified),
        (_counted(matches, "verified match", "verified matches"), not matches),
        (_counted(parts, "connected group", "unconnected groups"), parts > 1),
        (_counted(weak, "weakly tied image", "weakly tied images") + f" (< {WEAK_MATCHES} matches)", weak > 0),
        (_counted(len(failures), "failure", "failures"), bool(failures)),
    ]
    parted = [(text.partition(" "), bad) for text, bad in tiles]
    return [(count, words, "bad" if bad else "") for (count, _, words), bad in parted]


def _all_notices(
    context: Context,
    images: Sequence[ImageRow],
    pairs: Sequence[PairRow],
    facts: Mapping[str, Any],
    warnings: Sequence[str],
) -> list[Notice]:
    """The gravest first."""
    doubtful = _facts(context, "consistency").get("doubtful", ())
    found = notices(images, pairs, facts, _facts(context, "orient"))
    found += adjustment_notices(images, _facts(context, "adjust"), doubtful)
    found += [Notice("warn", "Note on the input", warning) for warning in warnings]
    return sorted(found, key=lambda notice: notice.level != "bad")


def notices(
    images: Sequence[ImageRow],
    pairs: Sequence[PairRow],
    facts: Mapping[str, Any],
    judged: Mapping[str, Any],
) -> list[Notice]:
    """What needs a person's eye, the gravest first. facts: of the filter; judged: of the orientation."""
    found = []
    names = {row.image_id: row.name for row in images}
    if not facts["verified_matches"]:
        found.append(Notice("bad", "No pair is verified", "The block has no tie points; the pair table says why."))
    elif len(facts["components"]) > 1:
        sizes, alone = facts["components"], sum(size == 1 for size in facts["components"])
        shown = ", ".join(f"{size:,}" for size in sizes[:12] if size > 1)
        text = f"Sizes of the groups with more than one image: {shown}. Images tied to no other: {alone:,}."
        found.append(Notice("bad", f"The block falls into {len(sizes):,} unconnected groups of images", text))
    used = "the given one is kept" if judged.get("stays") else "the one from the pictures is used"
    for key, what, unit in (("wrong_attitudes", "attitude", "°"), ("wrong_positions", "position", " m")):
        items = tuple(f"{names.get(i, i)}: {off:.1f}{unit}" for i, off in judged.get(key, {}).items())
        if items:
            text = f"The pictures contradict the given {what} by what is shown; {used}."
            found.append(Notice("bad", _counted(len(items), f"wrong {what}", f"wrong {what}s"), text, items))
    for camera_id, (before, now) in judged.get("focal_lengths", {}).items():
        text = f"Camera {camera_id}: {now:.0f} px in the pictures, {before:.0f} px before; {used}."
        found.append(Notice("warn", "Another focal length", text))
    if facts["weakly_tied"] and facts["verified_matches"]:
        ties = {row.image_id: row for row in images}
        items = tuple(f"{names[i]} ({ties[i].verified_matches})" for i in facts["weakly_tied"])
        text = f"Fewer than {WEAK_MATCHES} verified matches in all pairs together (number in brackets)."
        title = _counted(len(items), "image is weakly tied", "images are weakly tied")
        found.append(Notice("bad", title, text, items))
    for pose, lacks, text in (
        ("none", "no position", "Paired by name or time, and not on the map."),
        ("position", "no usable attitude", "Paired by position, and drawn without footprint."),
    ):
        items = tuple(row.name for row in images if row.pose == pose)
        if items:
            title = _counted(len(items), f"image has {lacks}", f"images have {lacks}")
            found.append(Notice("warn", title, text, items))
    lost = sum(row.state == NOT_JUDGED for row in pairs)
    if lost:
        text = (
            "No matches of the present keypoints are on file: the match stage failed there, or keypoints were found "
            "again since. Run aeromatch match and then aeromatch filter, or aeromatch run."
        )
        found.append(Notice("warn", _counted(lost, "pair was not judged", "pairs were not judged"), text))
    return found


def adjustment_notices(
    images: Sequence[ImageRow], adjusted: Mapping[str, Any], doubtful: Sequence[str]
) -> list[Notice]:
    """Images that the bundle adjustment does not hold, and what else it found. adjusted: its facts. doubtful: images
    whose adjusted poses their matches contradict.
    """
    names = {row.image_id: row.name for row in images}
    found = [Notice("warn", "Note on the adjustment", remark) for remark in adjusted.get("remarks", ())]
    outside = tuple(f"{names.get(i, i)}: {reason}" for i, reason in adjusted.get("outside", {}).items())
    if outside:
        text = "Their matches are exported, but they have no adjusted pose and see no point."
        found.insert(0, Notice("bad", _counted(len(outside), "image", "images") + " not oriented", text, outside))
    if doubtful:
        title = _counted(len(doubtful), "adjusted pose is doubtful", "adjusted poses are doubtful")
        text = "Too many verified matches of these images contradict their adjusted poses."
        found.insert(0, Notice("bad", title, text, tuple(names.get(i, i) for i in doubtful)))
    return found


def _counted(count: int, one: str, several: str) -> str:
    return f"{count:,} {one if count == 1 else several}"


def _facts(context: Context, stage: str) -> dict[str, Any]:
    """What a stage left in its report."""
    path = context.workspace.stage_report(stage)
    return dict(read_json(path)["facts"]) if path.is_file() else {}


def _camera_words(cameras: Mapping[str, Camera]) -> str:
    """One camera a line: its model, size and parameters."""
    words = []
    for camera_id, camera in sorted(cameras.items()):
        params = ", ".join(f"{value:g}" for value in camera.params)
        words.append(f"{camera_id}: {camera.model}, {camera.width_px} x {camera.height_px} px, {params}")
    more = [f"and {len(words) - 10} more"] if len(words) > 10 else []
    return "\n".join(words[:10] + more)


def _block_facts(context: Context) -> list[tuple[str, str]]:
    block = context.block
    return [
        ("World frame", f"{block.crs}, minus the origin {' / '.join(f'{value:,.0f}' for value in block.origin_m)}"),
        ("Ground", block.ground_source),
        ("Ground sampling distance", "unknown" if block.gsd_m is None else f"{block.gsd_m:.3g} m"),
        ("Cameras", _camera_words(block.cameras)),
        ("Images in", context.settings.block.images),
    ]


def _adjusted_facts(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Figures of the bundle adjustment, and of the control points."""
    if not facts.get("points"):
        return []
    found = [
        ("Oriented images", f"{facts['images']:,}"),
        ("Points", f"{facts['points']:,} in {facts['track_length']:.1f} images each"),
        ("Reprojection error", f"{facts['reprojection_error_px']:.2f} px, mean"),
    ]
    sigmas = [f"{facts[key]:.3g} {unit}" for key, unit in _SIGMAS if facts[key] is not None]
    if sigmas:
        found.append(("Standard deviations of the poses", f"{', '.join(sigmas)}, median"))
    cameras = {k: Camera(model, w, h, tuple(params)) for k, (model, w, h, params) in facts.get("cameras", {}).items()}
    if cameras:
        found.append(("Cameras after the adjustment", _camera_words(cameras)))
    control = facts["control"]
    if control and control["control_rmse_m"]:
        found.append(("Control points", f"{control['control']}; {offset_words(control)}"))
        found.append(("Control points after a similarity", f"RMSE {_metres(control['control_rmse_m'])}"))
        if control["check_rmse_m"]:
            kind = f"{control['check']} check points" if control["check"] else "Control points, each left out once"
            found.append((f"{kind}, after it", f"RMSE {_metres(control['check_rmse_m'])}"))
        if control["doubtful"]:
            found.append(("Control points that the others contradict", ", ".join(control["doubtful"])))
    return found


def _metres(errors_m: Sequence[float]) -> str:
    return " / ".join(f"{error:.3f}" for error in errors_m) + " m (x / y / z)"


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


def _adjusted_block(context: Context) -> AdjustedBlock | None:
    """With the points that final matches hold; None where the last adjustment found none."""
    path = context.workspace.final_or_adjusted
    return read_adjusted(path) if _facts(context, "adjust").get("points") and path.is_file() else None


def _ground_figures(context: Context, adjusted: AdjustedBlock | None) -> list[tuple[str, str]]:
    footprints = [footprint.polygon_m for footprint in block_footprints(context.block).values()]
    centers = np.array([pose.center_m[:2] for pose in context.block.poses.values()]).reshape(-1, 2)
    return ground_figures(centers[np.isfinite(centers).all(axis=1)], footprints, adjusted)


def _map(
    context: Context,
    images: Sequence[ImageRow],
    pairs: Sequence[PairRow],
    wrong: Mapping[str, float],
    pictures: Mapping[str, NDArray[np.uint8]],
) -> MapFigure | None:
    """None where no image has a position. pictures: reduced ones, for the sketch of the ground."""
    stations = []
    for row, label in zip(images, _labels([row.name for row in images]), strict=True):
        pose = context.pose(row.image_id)
        if pose is None or not np.isfinite(pose.center_m).all():
            continue
        x, y, z = (float(value) for value in pose.center_m)
        ties = _counted(row.verified_matches, "verified match", "verified matches")
        title = f"{row.name}: {ties} in {row.verified_pairs} of {_counted(row.pairs, 'pair', 'pairs')}, z {z:.1f} m"
        weak = "weak" if row.verified_matches < WEAK_MATCHES else "fine"
        stations.append(Station(row.image_id, label, title, x, y, "wrong" if row.image_id in wrong else weak))
    if not stations:
        return None
    footprints = [footprint.polygon_m for footprint in block_footprints(context.block).values()]
    in_world = _facts(context, "orient").get("frame") != "own"
    sketch = partial(ground_sketch, context, pictures)
    return block_map(stations, footprints, [_link(row) for row in pairs], in_world=in_world, sketch=sketch)


def _link(row: PairRow) -> Link:
    verified = _counted(row.verified, "verified match", "verified matches")
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
