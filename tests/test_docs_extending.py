"""The code of docs/extending.md does what the page says."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from make_features import described
from read_pages import ROOT, text_of
from test_export_colmap import make_truth

from aeromatch_cli import graph
from aeromatch_cli.blocks.pose_files.source import Source
from aeromatch_cli.blocks.pose_files.table import POSE_FORMATS
from aeromatch_cli.config.schema import FAMILIES
from aeromatch_cli.data import Pair, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate import output, scores, totals
from aeromatch_cli.executor import Executor
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.results import stages as results
from aeromatch_cli.store.block_store import BlockStore
from aeromatch_cli.store.index import Index
from aeromatch_cli.workspace import Workspace

PAGE = text_of(ROOT / "docs" / "extending.md")
NEW_FILE = re.compile(r"(?m)^`(aeromatch_cli/[\w/]+\.py)`:\n\n((?:(?: {4}.*)?\n)+)")


def new_files() -> dict[str, str]:
    return {path: textwrap.dedent(code) for path, code in NEW_FILE.findall(PAGE)}


def snippet(first: str) -> str:
    """The code of the page that begins with these words, up to the end of its block."""
    found = re.search(rf"(?m)^ {{4}}{re.escape(first)}(?:.*\n)(?:(?: {{4}}.*)?\n)*", PAGE)
    assert found is not None, first
    return textwrap.dedent(found[0]).strip()


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """Modules of the page by file name; what the page's stage adds to other modules is there as well."""
    names: dict[str, Any] = {**vars(results), **vars(graph)}
    exec(snippet("class ConnectionsResult"), names)
    monkeypatch.setattr(results, "ConnectionsResult", names["ConnectionsResult"], raising=False)
    stage = eval(snippet('Stage("connections"'), names)[0]
    monkeypatch.setattr(graph, "BY_NAME", {**graph.BY_NAME, stage.name: stage})
    exec(snippet("@property\n    def connections"), names)
    monkeypatch.setattr(Workspace, "connections", names["connections"], raising=False)
    modules = {}
    for path, code in new_files().items():
        module = types.ModuleType(f"extending_{Path(path).stem}")
        sys.modules[module.__name__] = module  # pydantic looks annotations up there
        exec(compile(code, path, "exec"), module.__dict__)
        modules[Path(path).stem] = module
    yield modules
    for module in modules.values():
        del sys.modules[module.__name__]


def test_the_page_has_four_files_of_thirty_odd_lines_in_folders_that_exist() -> None:
    files = new_files()
    assert [Path(path).name for path in files] == ["distance.py", "mission_log.py", "tiepoints.py", "connections.py"]
    for path, code in files.items():
        assert (ROOT / path).parent.is_dir()
        assert not (ROOT / path).exists()
        assert len(code.strip().splitlines()) <= 40


def test_files_that_the_page_changes_exist() -> None:
    changed = re.findall(r"(?m)^\| (`[^|]+`) \| (.+) \|$", PAGE)
    names = [name for cell, what in changed if not what.startswith("new:") for name in re.findall(r"`([^`]+)`", cell)]
    assert len(names) > 8
    assert [name for name in names if not (ROOT / name).exists()] == []


def test_the_matcher_finds_what_is_alike(made: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 200, (50, 128), dtype=np.uint8)
    order = rng.permutation(50)
    second = first[order] + rng.integers(0, 3, (50, 128)).astype(np.uint8)
    second[:10] = 255  # nothing like these
    points = rng.random((50, 2)) * 700
    matcher = made["distance"].Distance(max_distance=100.0)
    geometry = PairGeometry(Pair("a", "b", 0.5, 10.0, "overlap"), None, None, None, None, None)  # type: ignore[arg-type]
    found = matcher(described(points, first), described(points[order], second), geometry)
    assert {(int(a), int(b)) for a, b in found.indices} == {(int(order[k]), k) for k in range(10, 50)}
    assert (found.indices.dtype, found.scores.dtype, found.view_pairs.dtype) == (np.int32, np.float32, np.int16)
    assert (found.scores > 0.5).all()
    assert len(matcher(described(points[:0], first[:0]), described(points, second), geometry).indices) == 0
    assert fingerprint(matcher) != fingerprint(made["distance"].Distance())
    assert matcher.name not in FAMILIES["match"]


def test_the_pose_format_is_read(made: dict[str, Any], tmp_path: Path) -> None:
    place = {"lat": 52.5, "lon": 13.4, "alt": 142.0}
    photos = [{"image": "a.jpg", **place, "yaw": 350.0, "pitch": 1.0, "roll": 0.0}, {"image": "b.jpg", **place}]
    path = tmp_path / "flight.json"
    path.write_text(json.dumps({"photos": photos}), encoding="utf-8")
    reader = made["mission_log"]
    assert reader.is_mission_log(Source(path))
    first, second = reader.read_mission_log(Source(path)).rows
    assert (first.image, first.position, first.position_kind) == ("a.jpg", (52.5, 13.4, 142.0), "geographic")
    assert (first.attitude, first.attitude_kind) == ((350.0, 1.0, 0.0), "yaw_pitch_roll")
    assert (second.attitude, second.attitude_kind) == (None, "none")
    path.write_text('{"photos": [{"image": "a.jpg"}]}', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"flight\.json, photo 1: needs image, lat, lon and alt"):
        reader.read_mission_log(Source(path))
    for text in ('{"photos": ["a.jpg"]}', '{"photos": [{"image": "a.jpg", "lat": "n"}]}'):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match="photo 1"):
            reader.read_mission_log(Source(path))


def test_names_of_the_page_are_new() -> None:
    """What a page adds must not be there: its table line would replace another."""
    added = {"match": "distance", "export": "tiepoints"}
    assert [name for family, name in added.items() if name in FAMILIES[family]] == []
    assert '"mission-log": PoseFormat' in PAGE
    assert "mission-log" not in POSE_FORMATS
    assert "connections" not in graph.BY_NAME


def test_the_stage_writes_its_table_where_it_is_not_up_to_date(
    made: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = made["connections"]
    pairs = tuple(Pair("a", second, 0.5, 10.0, "overlap") for second in ("b", "c"))
    entries = [
        (pair, SimpleNamespace(matches=SimpleNamespace(indices=range(n))))
        for pair, n in zip(pairs, (7, 0), strict=True)
    ]
    store = BlockStore(Workspace(tmp_path), Index())
    context = SimpleNamespace(
        workspace=store.workspace, pairs=pairs, store=store, recorded=store.report, executor=Executor("serial", 1)
    )
    state = SimpleNamespace(with_current_pairs=lambda: (context, []), inputs_fingerprint=lambda _: "some verdicts")
    module.BlockState = SimpleNamespace(of=lambda _: state)
    declared = graph.Stage("connections", "block", module.ConnectionsResult)
    monkeypatch.setattr(graph, "BY_NAME", {**graph.BY_NAME, "connections": declared})
    module.final_pairs = lambda _: entries
    first, second = module.run(context), module.run(context)
    assert ((first.done, first.skipped), (second.done, second.skipped)) == ((1, 0), (0, 1))
    assert first.result.connected_pairs == second.result.connected_pairs == 1
    assert (tmp_path / "connections.csv").read_text(encoding="utf-8").splitlines()[1:] == ["a,b,7"]
    (tmp_path / "connections.csv").unlink()
    assert module.run(context).done == 1
    state.inputs_fingerprint = lambda _: "other verdicts"
    assert module.run(context).done == 1


def test_the_exporter_writes_every_verified_match(made: dict[str, Any], tmp_path: Path) -> None:
    truth = make_truth()
    exporter = made["tiepoints"].TiePoints(decimals=2)
    summary = exporter(truth.contents(), tmp_path / "tiepoints")
    (path,) = summary.files
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) - 1 == summary.verified_matches == sum(len(pair.verified) for pair in truth.pairs)
    pair = truth.pairs[0]
    place0, place1 = truth.keypoints_px["img0"][pair.verified[0, 0]], truth.keypoints_px["img1"][pair.verified[0, 1]]
    cells = lines[1].split(",")
    assert (cells[0], cells[3]) == ("flight/0.jpg", "flight/1.jpg")
    assert np.allclose([float(c) for c in (*cells[1:3], *cells[4:6])], [*place0, *place1], atol=0.006)
    assert exporter.name not in FAMILIES["export"]


def test_the_metric_is_a_percentile_and_its_places_exist() -> None:
    code = PAGE.partition("## A metric")[2]
    function = re.search(r"(?m)^ {4}def percentile_of(?:.*\n)(?: {8}.*\n)+", code)
    assert function is not None
    namespace = dict(vars(scores))
    exec(textwrap.dedent(function[0]), namespace)
    assert namespace["percentile_of"](np.array([1.0, 2.0, 3.0, np.nan]), 50.0) == 2.0
    assert np.isnan(namespace["percentile_of"](np.array([np.nan]), 90.0))
    for place in (scores.PairScore.row, totals.total, output._SCORE_COLUMNS, output.summary_rows):
        assert place  # each is named in the text
    assert all(name in code for name in ("`row`", "`total`", "`_SCORE_COLUMNS`", "`summary_rows`"))
    assert "errors_px" in {field.name for field in dataclasses.fields(scores.PairScore)}
