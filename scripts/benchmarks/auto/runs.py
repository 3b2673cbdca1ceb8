"""One method on one rendered block: rows of its pairs, kept on disk, so that a killed benchmark goes on there."""

from __future__ import annotations

import argparse
import re
import shutil
from contextlib import nullcontext
from pathlib import Path
from threading import RLock

from aeromatch_cli.config import parse_method
from aeromatch_cli.files import read_json, write_json
from benchmarks.auto.blocks import Block
from benchmarks.peers.base import Options
from benchmarks.peers.table import PEERS, reads_poses
from benchmarks.peers.worker import measure
from benchmarks.scenes import NOISY_POSES, Judged, with_noisy_poses
from benchmarks.sources import OUR_CODE, code_digest
from benchmarks.tables import Row, plain
from benchmarks.whole import FIGURES, judged_run

JUDGED = "auto"
# Of auto as it is: several settings of it, which run at a time, start from its one workspace.
_making = RLock()


def rows_of(args: argparse.Namespace, block: Block, judged: Judged, method: str) -> list[Row]:
    """A row for each judged pair."""
    with _making if method == JUDGED else nullcontext():
        return _rows_on_file(args, block, judged, method)


def _rows_on_file(args: argparse.Namespace, block: Block, judged: Judged, method: str) -> list[Row]:
    """Made first where they are not there, or of other code."""
    peer = method in PEERS
    folder = args.out / "runs" / block.slug / re.sub(r"[^a-z0-9.]+", "-", method.lower()).strip("-")
    path = folder / "rows.json"
    asked = {"method": method, "block": judged.key, "keypoints": args.keypoints}
    asked |= {} if peer else {"code": code_digest(*OUR_CODE)}
    known = read_json(path) if path.is_file() else {}
    if known.get("asked") != asked:
        found = _peer_rows(args, judged, method) if peer else _preset_rows(args, block, judged, method, folder)
        folder.mkdir(parents=True, exist_ok=True)
        known = {"asked": asked, "rows": found}
        write_json(path, known)
    return [{"block": block.name, "conditions": block.conditions, "method": method, **row} for row in known["rows"]]


def _preset_rows(args: argparse.Namespace, block: Block, judged: Judged, method: str, folder: Path) -> list[Row]:
    """By `aeromatch run` with the block's cameras and noisy poses. auto's workspace stays; auto with other settings
    goes on from a copy of it, so that only what these change is made again."""
    preset, own = parse_method(method)
    scene, work, start = judged.scene, folder / "work", None
    if preset == JUDGED and own:
        rows_of(args, block, judged, JUDGED)
        start = folder.with_name(JUDGED) / "work"
    poses = scene.poses.with_name(NOISY_POSES)
    by_pair, seconds = judged_run(method, scene.images, poses, scene.block, work, args.keypoints, jobs=1, start=start)
    if method != JUDGED:
        shutil.rmtree(work)
    found = [by_pair[pair.images] for pair in judged.pairs]
    return [{**row, "seconds": seconds / max(1, len(found))} for row in found]


def _peer_rows(args: argparse.Namespace, judged: Judged, peer: str) -> list[Row]:
    """Every judged pair in turn; features of an image count once."""
    limits = Options(args.keypoints, "image", 1, 0, args.reference_weights)
    noisy = with_noisy_poses(judged) if reads_poses(peer) else None
    rows: list[Row] = []
    known: set[str] = set()
    for pair, (_, measured) in zip(
        judged.pairs, measure(peer, noisy or judged, limits, args.out / "found"), strict=True
    ):
        found = measured.found
        answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
        score = judged.truth.judge(*pair.images, *answer).row()
        again = [s for image, s in zip(pair.images, measured.features_seconds, strict=True) if image in known]
        known.update(pair.images)
        rows.append({**{key: plain(score[key]) for key in FIGURES}, "seconds": measured.seconds - sum(again)})
    return rows
