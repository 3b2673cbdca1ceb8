"""The report page: its numbers against the workspace it was made from, escaping, previews, maps, empty blocks."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from make_results import filled
from markupsafe import escape
from PIL import Image as PilImage
from read_html import Structure, shapes

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.config import Settings, load
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Block, Camera, Features, Image, Matches, Pair, Pose, Verdict
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import write_atomically, write_json
from aeromatch_cli.formats.features import write_features
from aeromatch_cli.formats.rows import MatchEntry, VerifiedEntry, write_match_row, write_verified_row
from aeromatch_cli.report import gathering
from aeromatch_cli.report import page as report
from aeromatch_cli.report.adjustment import Adjustment
from aeromatch_cli.report.gathering import Gathered, gather
from aeromatch_cli.report.pair_viewer import pair_table
from aeromatch_cli.report.previews import chosen_previews
from aeromatch_cli.report.rows import ImageRow, PairRow, stage_rows
from aeromatch_cli.results.stages import FilterResult, OrientResult, PairsResult, RefineResult
from aeromatch_cli.stages.context import Context, Given
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.workspace import Workspace

NASTY = '<img src=x onerror=alert(1)> & "ü b".png'
WIDTH, HEIGHT = 160, 128
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


def features() -> Features:
    """100 keypoints, each in the middle of its own cell of 16 x 16, row by row."""
    index = np.arange(100)
    points = np.stack([(index % 16 + 0.5) * WIDTH / 16 - 0.5, (index // 16 + 0.5) * HEIGHT / 16 - 0.5], axis=1)
    count = len(points)
    return Features(
        keypoints_px=points.astype(np.float32),
        sizes_px=np.ones(count, np.float32),
        responses=np.ones(count, np.float32),
        descriptors=np.zeros((count, 128), np.uint8),
        descriptor_keypoint_idx=index.astype(np.int32),
        view_idx=np.zeros(count, np.int32),
        view_keypoints_px=points.astype(np.float32),
        view_size_px=np.ones(count, np.float32),
        view_orientation_deg=np.zeros(count, np.float32),
        view_sizes_px=np.array([[WIDTH, HEIGHT]], np.int32),
        view_angles_deg=np.zeros(1, np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )


def matches(count: int) -> Matches:
    indices = np.repeat(np.arange(count, dtype=np.int32)[:, None], 2, axis=1)
    return Matches(indices, np.ones(count, np.float32), np.zeros((count, 2), np.int16))


def entry(
    image_id1: str, kept: int, matches_in: int, state: str, reason: str = "", error: float = 0.0
) -> VerifiedEntry:
    verdict = Verdict(
        keep=np.ones(kept, bool),
        state=state,  # type: ignore[arg-type]
        reason=reason,
        model_kind="E" if state == "verified" else "",
        errors_px=np.full(kept, error, np.float32),
        rejected={"poselib": matches_in - kept},
    )
    return VerifiedEntry(image_id1, "print", matches_in, matches(kept), verdict)


def block(poses: dict[str, Pose]) -> Block:
    names = {"a": "a.png", "b": "b.jpg", "c": NASTY, "d": "sub/d.png"}
    images = tuple(
        Image(image_id, name, WIDTH, HEIGHT, "cam", 6 if image_id == "b" else 1) for image_id, name in names.items()
    )
    camera = Camera("PINHOLE", WIDTH, HEIGHT, (200.0, 200.0, 79.5, 63.5))
    origin, ground = (500000.0, 5000000.0, 0.0), ConstantGround(0.0)
    return Block(images, {"cam": camera}, poses, "EPSG:32633", origin, ground, "given: 0 m", 0.5)


def full_poses() -> dict[str, Pose]:
    return {i: Pose(np.array([40.0 * k, 10.0 * k, 100.0]), LOOKING_DOWN, 1.0, 1.0) for k, i in enumerate("abcd")}


def context(root: Path, poses: dict[str, Pose], pairs: tuple[Pair, ...]) -> Context:
    (root / "images" / "sub").mkdir(parents=True)
    settings = Settings.model_validate({"block": {"images": str(root / "images")}})
    workspace = Workspace(root / "work")
    workspace.create()
    return Context(settings, workspace, Executor("serial"), Given(block(poses), {}), block(poses), pairs)


@pytest.fixture
def full(tmp_path: Path) -> Context:
    """a-b 60 of 80 and b-c 20 of 25 verified, a-c rejected, c-d not verifiable, a-d without matches on file."""
    pairs = (
        Pair("a", "b", 0.61, 7.3, "overlap"),
        Pair("a", "c", 0.32, 14.5, "overlap"),
        Pair("a", "d", float("nan"), float("nan"), "name"),
        Pair("b", "c", 0.55, 8.1, "overlap"),
        Pair("c", "d", 0.57, 8.9, "overlap"),
    )
    result = context(tmp_path, full_poses(), pairs)
    rng = np.random.default_rng(3)
    for image in result.block.images:
        write_atomically(result.workspace.features(image.image_id), lambda s: write_features(s, features(), "print"))
        pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        if image.image_id != "d":
            PilImage.fromarray(pixels).save(result.image_path(image))
    rows = {
        "a": [entry("b", 60, 80, "verified", error=0.72), entry("c", 0, 12, "rejected", "8 inliers of 12 matches")],
        "b": [entry("c", 20, 25, "verified", error=1.25)],
        "c": [entry("d", 0, 4, "not verifiable", "4 matches, 15 needed")],
    }
    for image_id, entries in rows.items():
        write_atomically(result.workspace.verified(image_id), lambda s, e=entries: write_verified_row(s, e))
        raw = [MatchEntry(e.image_id1, "print", "nearest", matches(e.matches_in)) for e in entries]
        write_atomically(result.workspace.matches(image_id), lambda s, r=raw: write_match_row(s, r))
    first = StageReport("pairs", items=5, done=5)
    first.result = filled(
        PairsResult, summary=["flying height    100 m"], warnings=["altitudes look relative"], images=4
    )
    first.write(result.workspace)
    StageReport("extract", items=5, done=4, failures=[("broken.png", "cut <off> & empty")]).write(result.workspace)
    judged = StageReport("filter", items=5, done=4)
    judged.result = filled(FilterResult, verified_matches=80)
    judged.write(result.workspace)
    oriented = StageReport("orient", items=4, done=4)
    oriented.result = filled(OrientResult, wrong_attitudes={"c": 178.4})
    oriented.write(result.workspace)
    return result


def page_of(result: Context) -> str:
    report.run(result)
    return result.workspace.report.read_text(encoding="utf-8")


def row_with(page: str, table: str, *cells: str) -> list[str]:
    """Texts of the cells of the one row of a table that begins with `cells`."""
    body = page.split(f'id="{table}"')[1].split("</table>")[0]
    found = []
    for row in re.findall(r"<tr[^>]*>(.*?)</tr>", body, re.S):
        texts = [re.sub(r"<[^>]+>", "", cell).strip() for cell in re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)]
        if texts[: len(cells)] == list(cells):
            found.append(texts)
    assert len(found) == 1
    return found[0]


def test_an_image_that_could_not_be_read_is_told_as_nothing_else(full):
    StageReport("extract", items=4, done=3, failures=[("d", "cut off")]).write(full.workspace)
    words = Structure.of(page_of(full)).words()
    assert "1 image could not be read" in words
    assert "1 connected group" in words
    assert "unconnected groups" not in words
    assert row_with(page_of(full), "image-table", "sub/d.png")[-1] == "could not be read."
    counted = (
        "An image that could not be read fails in orient and in extract, each time it is tried; match and what follows "
        "leave out its pairs."
    )
    assert counted in page_of(full)


def test_rows_hold_the_numbers_of_the_workspace(full):
    found = gather(full)
    pairs, images = found.pairs, found.images
    assert [(p.image_id0, p.image_id1, p.state, p.matches_in, p.verified) for p in pairs] == [
        ("a", "b", "verified", 80, 60),
        ("a", "c", "rejected", 12, 0),
        ("a", "d", "not judged", 0, 0),
        ("b", "c", "verified", 25, 20),
        ("c", "d", "not verifiable", 4, 0),
    ]
    assert pairs[0].median_error_px == pytest.approx(0.72)
    assert pairs[0].share == pytest.approx(0.75)
    assert pairs[0].rejects == {"poselib": 20}
    # b's verified points are the first 60 keypoints (with a) and the first 20 of the same (with c): 60 cells of 256.
    assert [(i.pairs, i.verified_pairs, i.verified_matches, i.coverage) for i in images] == [
        (3, 1, 60, 60 / 256),
        (2, 2, 80, 60 / 256),
        (3, 1, 20, 20 / 256),
        (2, 0, 0, 0.0),
    ]
    assert [i.keypoints for i in images] == [100] * 4
    assert [(i.views, i.shadow) for i in images] == [(None, None)] * 4


@pytest.mark.slow
def test_several_processes_gather_the_same(full, monkeypatch):
    whole = gather(full, pair_table)
    assert set(whole.drawn) == {("a", "b"), ("a", "c"), ("b", "c")}
    monkeypatch.setattr(gathering, "_FEW_PAIRS", 1)
    with Executor("processes", 2) as executor:
        several = replace(full, executor=executor)
        parts = gather(several, pair_table)
        full.workspace.verified("b").write_bytes(b"damaged")
        with pytest.raises(BrokenFileError, match=r"b\.npz"):
            gather(several, pair_table)
    assert vars(parts).keys() == vars(whole).keys()
    for one, other in zip(whole.pairs + whole.images, parts.pairs + parts.images, strict=True):
        np.testing.assert_equal(vars(other), vars(one))
    assert parts.drawn == whole.drawn


def test_images_tell_their_views_and_shadow(full):
    write_json(full.workspace.views("b"), {"views": [{"name": "source"}, {"name": "ground"}]})
    write_json(full.workspace.enhanced("b", ".json"), {"shadow_share": 0.34, "fingerprint": "x"})
    of_b = gather(full).images[1]
    assert (of_b.views, of_b.shadow) == (2, 0.34)


def test_steps_tell_that_their_counts_are_of_before_the_last_drops(full):
    assert "dropped some; the column Verified" not in page_of(full)
    lines = ["image_id0,image_id1,steps,reasons,settled_by,lacks,verified,expected", "a,b,first,,first,,60,"]
    full.workspace.steps.write_text("\n".join(lines) + "\n")
    words = (
        "by the verified matches that it had before the stage consistency dropped some; the column Verified counts "
        "those that are left"
    )
    cascaded = replace(full, settings=full.settings.model_copy(update={"cascade": load("auto", []).cascade}))
    assert words in page_of(cascaded)


def test_images_tell_the_views_that_the_steps_of_a_cascade_made(full):
    cascaded = replace(full, settings=full.settings.model_copy(update={"cascade": load("auto").cascade}))
    write_json(full.workspace.of_step("first", "first").views("b"), {"views": [{"name": "ground"}]})
    write_json(full.workspace.of_step("learned", "learned").enhanced("b", ".json"), {"shadow_share": 0.2})
    of_b = gather(cascaded).images[1]
    assert (of_b.views, of_b.shadow) == (1, 0.2)


def test_page_shows_headline_tables_and_reasons(full):
    page = page_of(full)
    words = Structure.of(page).words()
    for text in (
        "4 images",
        "4 with position, 4 with attitude, given or found",
        "5 pairs compared",
        "2 verified pairs",
        "80 verified matches",
        "2 unconnected groups",
        "2 weakly tied images (< 50 matches)",
        "1 failure",
        f"{NASTY}: 178.4°",
        "altitudes look relative",
        "flying height 100 m",
        "cut <off> & empty",
        "1 pair was not judged",
        "EPSG:32633",
        "given: 0 m",
    ):
        assert text in words, text
    ab = row_with(page, "pair-table", "a.png", "b.jpg")
    assert ab == ["a.png", "b.jpg", "overlap", "61", "7.3", "80", "60", "75", "0.72", "verified", "E", "", "poselib 20"]
    ac = row_with(page, "pair-table", "a.png", str(escape(NASTY)))
    assert ac[5:7] == ["12", "0"]
    assert ac[9:12] == ["rejected", "", "8 inliers of 12 matches"]
    assert row_with(page, "image-table", "sub/d.png")[1:] == [
        *("full", "", "", "100", "2", "0", "0", "0", "", "", ""),
        "weakly tied.",
    ]
    assert row_with(page, "stage-table", "extract")[3:7] == ["5", "4", "0", "1"]
    assert "name: poselib" in words  # the settings


def test_page_escapes_names_and_needs_no_network(full):
    page = page_of(full)
    structure = Structure.of(page)
    assert NASTY in structure.words()
    assert "<img" not in page
    assert "onerror=alert(1)>" not in page
    assert not re.search(r"https?://|url\((?!#)|@import", page)
    for _, key, value in structure.attributes:
        assert not key.startswith("on")
        if key in ("src", "srcset", "data", "action") or key.endswith("href"):
            assert value.startswith(("data:image/jpeg;base64,", "data:image/png;base64,", "#", "../../images/"))


def test_every_figure_of_the_page_is_well_formed_and_the_map_shows_the_poses(full):
    figures = re.findall(r"<svg.*?</svg>", page_of(full), re.S)
    for svg in figures:
        assert ElementTree.fromstring(svg).get("viewBox")
    (block_map,) = (svg for svg in figures if 'aria-label="Block map"' in svg)
    cameras = [shape for kind in ("fine", "weak", "wrong") for shape in shapes(block_map, kind)]
    assert [title for title, _ in cameras] == [
        "a.png: 60 verified matches in 1 of 3 pairs, z 100.0 m",
        "b.jpg: 80 verified matches in 2 of 2 pairs, z 100.0 m",
        "sub/d.png: 0 verified matches in 0 of 2 pairs, z 100.0 m",
        f"{NASTY}: 20 verified matches in 1 of 3 pairs, z 100.0 m",
    ]
    a, b, d, c = np.array([place for _, place in cameras])
    # 40 m to the east and 10 m to the north from each camera to the next.
    np.testing.assert_allclose([c - b, d - c], [b - a] * 2, atol=0.11)
    assert -(d - a)[1] == pytest.approx((d - a)[0] / 4, abs=0.1)
    ((title, line),) = shapes(block_map, "rejected")
    assert title == f"a.png – {NASTY}: rejected: 8 inliers of 12 matches"
    np.testing.assert_allclose(np.reshape(line, (2, 2)), [a, c], atol=0.11)


@pytest.mark.parametrize(
    ("frames", "in_world", "shown"), [({"c": 1}, True, "abd"), ({"a": 1, "b": 1, "c": 2}, False, "ab")]
)
def test_images_of_other_groups_have_no_place_on_the_map(full, frames, in_world, shown):
    """a and b are tied to each other, c to neither; d is not oriented, but has a position in the world."""
    poses = {i: AdjustedPose(full.block.poses[i].center_m, LOOKING_DOWN, *np.zeros((2, 3))) for i in "abc"}
    tracks = {i: np.column_stack([np.arange(30), np.arange(30) + 30 * (i == "c")]).astype(np.int32) for i in "abc"}
    points_m = np.zeros((60, 3))
    adjusted = AdjustedBlock(full.block.cameras, poses, points_m, np.zeros(60), tracks, frames)
    own_frame = adjusted.aside(in_world=True) if in_world else full.block.poses.keys()
    found = gather(full, pair_table, own_frame=own_frame)
    page = report.render(full, found, Adjustment(in_world=in_world), adjusted)
    tile = "3 with position, 3 with attitude, given or found; 1 oriented in a frame of their own"
    if not in_world:
        tile = "0 with position, 0 with attitude, given or found; 4 oriented in a frame of their own"
    assert tile in Structure.of(page).words()
    assert row_with(page, "image-table", "a.png")[1] == ("full" if in_world else "own frame")
    assert "Not drawn: 1 image of other groups, whose place beside the first is not known." in page
    (block_map,) = (svg for svg in re.findall(r"<svg.*?</svg>", page, re.S) if 'aria-label="Block map"' in svg)
    cameras = [title for kind in ("fine", "weak", "wrong") for title, _ in shapes(block_map, kind)]
    names = {image.image_id: image.name for image in full.block.images}
    assert sorted(title.split(": ")[0] for title in cameras) == sorted(names[i] for i in shown)
    assert ("metres" in block_map, "arbitrary units" in block_map) == (in_world, not in_world)
    assert "The other groups of images are left out." in page


def test_the_guide_names_the_parts_of_the_page_in_their_order(full):
    nav = re.findall(
        r'<a href="#\w+">(.*?)</a>',
        (Path(__file__).parents[1] / "aeromatch_cli" / "report" / "page.html.jinja").read_text(encoding="utf-8"),
    )
    guide = (Path(__file__).parents[1] / "docs" / "guide.md").read_text(encoding="utf-8")
    bullets = guide[guide.index("From the top:") : guide.index("### Good, doubtful, bad")]
    named = [words.lower() for words in re.findall(r"\*\*(.*?)\*\*", bullets)]
    places = [next(k for k, words in enumerate(named) if label.lower() in words) for label in nav]
    assert len(nav) == 12
    assert places == sorted(places), [named[k] for k in places]


def test_previews_are_best_worst_and_rejected_and_missing_files_are_noted(full):
    page = page_of(full)
    headings = re.findall(r"<h3[^>]*>(.*?)</h3>", page)
    assert headings == [
        "Best verified pair: a.png – b.jpg",
        f"Worst verified pair: b.jpg – {escape(NASTY)}",
        f"Rejected pair: a.png – {escape(NASTY)}",
    ]
    assert page.count('class="preview"') == 3
    full.image_path(full.block.images[0]).unlink()
    page = page_of(full)
    Structure.of(page)
    assert page.count('class="preview"') == 1
    assert page.count("no preview: cannot read image") == 2


def test_preview_of_many_pairs_takes_the_median():
    rows = [pair_row(i, "verified", matches=10 * i) for i in range(1, 10)]
    chosen = chosen_previews(rows)
    assert [(heading, row.verified) for heading, row in chosen] == [
        ("Best verified pair", 90),
        ("Median verified pair", 50),
        ("Worst verified pair", 10),
    ]


def test_page_without_poses_features_or_verified_pairs(tmp_path):
    empty = context(tmp_path, {}, (Pair("a", "b", float("nan"), float("nan"), "name"),))
    words = Structure.of(page_of(empty)).words()
    for text in (
        "There is no map: no image has a position.",
        "No pair is verified",
        "There is nothing to show",
        "No stage has left a report yet.",
        "4 images have no position",
    ):
        assert text in words, text
    assert row_with(page_of(empty), "image-table", "a.png")[2:] == [
        "",
        "",
        "",
        "1",
        "0",
        "0",
        "",
        "",
        "",
        "",
        "no features. weakly tied.",
    ]
    filed = [row.label for row in stage_rows(empty.workspace)]
    assert filed == []  # the report stage does not report about itself


def test_page_of_positions_only_and_of_one_image(tmp_path):
    poses = {i: replace(pose, world_rotation=None) for i, pose in full_poses().items()}
    words = Structure.of(page_of(context(tmp_path / "positions", poses, ()))).words()
    assert "4 images have no usable attitude" in words
    assert "0 with attitude" in words
    alone = context(tmp_path / "alone", {"a": full_poses()["a"]}, ())
    alone = replace(alone, block=replace(alone.block, images=alone.block.images[:1]))
    page = page_of(alone)
    Structure.of(page)
    (block_map,) = re.findall(r'<svg[^>]*aria-label="Block map".*?</svg>', page, re.S)
    assert len(shapes(block_map, "weak")) == 1


def test_shards_are_summed_per_stage(tmp_path):
    one = context(tmp_path, {}, ())
    for index in (1, 2):
        path = one.workspace.stage_report("match", f"{index}-of-2")
        counts = {"seconds": 1.5, "items": 10, "done": 9, "skipped": 0, "failed": 1}
        write_json(path, {"stage": "match", **counts, "result": None, "failures": []})
        write_json(
            one.workspace.of_step("first", "first").stage_report("match", f"{index}-of-2"),
            {"stage": "match", **counts, "result": None, "failures": []},
        )
    (row,) = stage_rows(one.workspace)
    # Of the shards' own folders and of the steps of a cascade.
    assert (row.label, row.seconds, row.items, row.done, row.failed) == ("match (2 shards)", 6.0, 40, 36, 4)


def test_results_of_stages_are_told_in_words_and_internals_are_not(tmp_path):
    workspace = Workspace(tmp_path)
    counts = {"seconds": 1.0, "items": 8, "done": 8, "skipped": 0, "failed": 0, "failures": []}
    oriented = filled(OrientResult, images_matched=8, frame="world", points=5925)
    write_json(workspace.stage_report("orient"), {"stage": "orient", **counts, "result": oriented.as_json()})
    refined = RefineResult(keypoints=25068, measured=23385, shift_px=0.2436)
    write_json(workspace.stage_report("refine"), {"stage": "refine", **counts, "result": refined.as_json()})
    assert [row.facts for row in stage_rows(workspace)] == [
        "8 images matched in the first pass, 5,925 points",
        "23,385 keypoints measured, 25,068 matched, moved by 0.24 px (median)",
    ]


def pair_row(index: int, state: str, matches: int, ids: tuple[str, str] = ("a", "b")) -> PairRow:
    reason = "" if state == "verified" else "3 inliers of 40 matches, 15 needed"
    verified = matches if state == "verified" else 0
    known = (*ids, *ids, 0.5 + index * 1e-6, 12.0, "overlap", matches + 9, verified, 0.61)
    return PairRow(*known, state, reason, "E", {"poselib": 9})


def test_table_of_many_pairs_keeps_the_worst_of_both_kinds():
    rows = [pair_row(i, "verified" if i % 2 else "rejected", matches=100 + i) for i in range(6000)]
    shown = report._worst_pairs(rows)
    assert len(shown) == report.MAX_TABLE_ROWS
    assert [row.state for row in shown] == ["rejected"] * 1000 + ["verified"] * 1000
    assert shown[0].overlap == max(row.overlap for row in rows if row.state == "rejected")
    assert [row.verified for row in shown[1000:1003]] == [101, 103, 105]


@pytest.mark.slow
def test_large_block_stays_a_small_page(tmp_path):
    ids = [f"flight_1_image_{k:05d}_jpg" for k in range(1000)]
    base = context(tmp_path, {}, ())
    images = tuple(Image(i, f"{i[:-4]}.jpg", WIDTH, HEIGHT, "cam") for i in ids)
    centers = {i: np.array([20.0 * (k % 40), 20.0 * (k // 40), 100.0]) for k, i in enumerate(ids)}
    poses = {i: Pose(center, LOOKING_DOWN, 1.0, 1.0) for i, center in centers.items()}
    large = replace(base, block=replace(base.block, images=images, poses=poses))
    pairs = [
        pair_row(k, "verified" if step % 3 else "rejected", 20 + 37 * k % 900, (ids[k], ids[k + step]))
        for k in range(1000)
        for step in (1, 2, 3, 39, 40, 41, 80, 81, 120, 121)
        if k + step < 1000
    ]
    rows = [ImageRow(i, f"{i[:-4]}.jpg", "", "full", 4000, 20, 14, 5000, 0.8) for i in ids]
    page = report.render(large, Gathered(pairs, rows, {}), Adjustment())
    Structure.of(page)
    assert len(page.encode()) < 3_000_000
    assert page.count("<tr>") < 3100
    assert f"{len(pairs):,} rows" in page
