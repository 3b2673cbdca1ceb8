"""The stages, declared: what each works on, which files of a workspace it reads and writes, which settings it reads
first, and the type of its result.

Their order, which of them can be cut into shards, which command makes which file, and from where on a changed setting
has everything made again follow from these declarations. A test compares them with the files that stages open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import PurePosixPath
from typing import Literal

from aeromatch_cli.results.stages import (
    AdjustResult,
    ConsistencyResult,
    EnhanceResult,
    ExportResult,
    ExtractResult,
    FilterResult,
    MatchResult,
    OrientResult,
    PairsResult,
    RefineResult,
    ReportResult,
    StageResult,
    ViewsResult,
)

FILES: Mapping[str, tuple[str, ...]] = {
    "tables": ("block.json", "images.csv", "cameras.csv", "poses.csv", "pairs.csv", "config.yaml"),
    "orientation": (
        "orientation/orientation.json", "orientation/cameras.csv", "orientation/poses.csv", "orientation/terrain*.tif",
        "orientation/first_pass/*",
    ),
    "enhanced": ("enhanced/*",),
    "views": ("simulated/*",),
    "features": ("features/*",),
    "matches": ("matches/*",),
    "verified": ("verified/*",),
    "steps": ("steps.csv",),
    "refined": ("refined/*",),
    "adjusted": (
        "orientation/adjusted.npz", "orientation/orientation.csv", "orientation/residuals.csv",
    ),
    "final": ("orientation/dropped.npz", "orientation/final.npz"),
    "export": ("export/*",),
    "report": ("report/*",),
    "evaluation": ("evaluation/*",),
}  # fmt: skip
"""Kinds of files below a workspace: name -> patterns, in which * stands for folders as well."""


@dataclass(frozen=True)
class Stage:
    """unit: what its items are; those of images and pairs are independent of each other, but those of refine, whose
    files are up to date as a whole. reads, writes: kinds of
    `FILES`; what a stage writes it may read. settings: sections of the settings, and single settings, of which it is
    the first stage that reads them. in_run: whether `run` takes it; others only show what `extract` does."""

    name: str
    unit: Literal["image", "pair", "block"]
    result: type[StageResult]
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    in_run: bool = True


_MATCHED = ("tables", "orientation", "features", "verified")

STAGES: tuple[Stage, ...] = (
    Stage("orient", "block", OrientResult, (), ("orientation",), ("block", "orient")),
    Stage("pairs", "block", PairsResult, ("orientation",), ("tables",), ("pairs",)),
    Stage("enhance", "image", EnhanceResult, ("tables", "orientation"), ("enhanced",), in_run=False),
    Stage("simulate", "image", ViewsResult, ("tables", "orientation"), ("enhanced", "views"), in_run=False),
    Stage(
        "extract", "image", ExtractResult, ("tables", "orientation"), ("enhanced", "views", "features"),
        ("enhance", "simulate", "extract"),
    ),
    Stage(
        # The steps of a cascade, their verification included, are made within match.
        "match", "pair", MatchResult, ("tables", "orientation", "features"), ("matches", "verified", "steps"),
        ("match", "cascade"),
    ),
    Stage("filter", "pair", FilterResult, (*_MATCHED, "matches"), ("verified",), ("seed", "filter")),
    Stage("refine", "image", RefineResult, _MATCHED, ("refined",), ("refine",)),
    Stage(  # matches: of match=polar, whose points are no keypoints
        "adjust", "block", AdjustResult, (*_MATCHED, "matches", "views", "refined"), ("adjusted",),
        ("block.gcp", "block.gcp_marks", "block.gcp_use", "adjust"),
    ),
    Stage("consistency", "block", ConsistencyResult, (*_MATCHED, "refined", "adjusted"), ("final",), ("consistency",)),
    Stage(
        "export", "block", ExportResult, (*_MATCHED, "matches", "refined", "adjusted", "final"), ("export",),
        ("export",),
    ),
    Stage(
        "report", "block", ReportResult,
        (*_MATCHED, "matches", "steps", "enhanced", "views", "refined", "adjusted", "final", "evaluation"), ("report",),
    ),
)  # fmt: skip

BY_NAME: Mapping[str, Stage] = {stage.name: stage for stage in STAGES}
ORDER: tuple[str, ...] = tuple(BY_NAME)
RUN: tuple[str, ...] = tuple(stage.name for stage in STAGES if stage.in_run)
# The stages that a command brings up to date after `orient` and `pairs`, which all commands begin with.
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "orient": (), "pairs": (), "enhance": ("enhance",), "simulate": ("simulate",), "extract": ("extract",),
    "match": ("extract", "match"), "filter": ("filter",), "adjust": ("refine", "adjust", "consistency"),
    "export": ("refine", "adjust", "consistency", "export"), "report": ("report",), "run": RUN[2:],
}  # fmt: skip
# These work on what other commands have made.
NEED_RESULTS = ("filter", "adjust", "export")


def course(*, shard: bool) -> tuple[str, ...]:
    """The stages of a run, in order; those of a shard end where what follows needs the whole block."""
    return RUN[: RUN.index("filter") + 1] if shard else RUN


def sharded(command: str) -> bool:
    """Whether `--shard` cuts a command: the items of its stages are independent of each other. Of a run those are that
    come before the block is adjusted."""
    if command == "run":
        return True
    return command in COMMANDS and all(BY_NAME[name].unit != "block" for name in COMMANDS[command])


def per_item() -> tuple[str, ...]:
    """Stages whose items are images or pairs, as the first part of a run takes them: without refine, which comes later
    and is up to date as a whole."""
    return tuple(stage.name for stage in STAGES if stage.unit != "block" and stage.name != "refine")


def stage_that_makes(path: PurePosixPath) -> str:
    """The stage that makes a file of a workspace, "" where none does. path: below the workspace."""
    if path.parts[0] == "reports":
        return path.name.partition(".")[0]
    kinds = {kind for kind, patterns in FILES.items() if any(fnmatch(str(path), one) for one in patterns)}
    return next((stage.name for stage in reversed(STAGES) if kinds & set(stage.writes)), "")


def makes(command: str, path: PurePosixPath) -> bool:
    """Whether a command makes a file of a workspace again where it is damaged."""
    stage = stage_that_makes(path)
    return command == "run" or stage in ("", "orient", "pairs", "enhance", "simulate", *COMMANDS.get(command, ()))


def first_reader(setting: str) -> str:
    """The first stage that reads a setting such as block.gcp, "" where it changes no result."""
    by_setting = {name: stage.name for stage in STAGES for name in stage.settings}
    return by_setting.get(setting) or by_setting.get(setting.partition(".")[0], "")
