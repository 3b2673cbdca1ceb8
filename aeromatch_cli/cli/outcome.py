"""What `--json` prints as the last line of stdout, as a schema.

To bring the file up to date: `python -m aeromatch_cli.cli.outcome > docs/outcome.schema.json`.
"""

from __future__ import annotations

import json
import sys
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter


class Facts(BaseModel):
    """Figures of a stage; further ones may be there, and docs/workspace.md has them all (`reports/<stage>.json`)."""

    model_config = ConfigDict(extra="allow")


class OrientFacts(Facts):
    """Of `orient`: what the pictures say of the poses."""

    poses_from: str | None = Field(None, description="Where the poses of the block come from, in words.")
    frame: Literal["world", "own"] | None = Field(None, description="own: no position was given; metres mean nothing.")
    wrong_attitudes: dict[str, float] = Field({}, description="Image -> degrees off.")
    wrong_positions: dict[str, float] = Field({}, description="Image -> metres off.")
    outside: list[str] = Field([], description="Images that the pictures could not orient.")


class PairsFacts(Facts):
    """Of `pairs`: the block as it was read."""

    images: int | None = Field(None, description="Images of the block.")
    summary: list[str] = Field([], description="What is printed of the block, line by line.")
    block: dict[str, Any] = Field(
        {},
        description="The same in figures: crs, gsd_m, flying_height_m, pairs ... With metric: false the scale is "
        "arbitrary, and lengths are null.",
    )
    warnings: list[str] = Field([], description="What a person should look at.")
    urgent: list[str] = Field([], description="Those of the warnings that --quiet does not hide.")
    unread: dict[str, str] = Field({}, description="Picture of a kind that is not read -> reason.")


class MatchFacts(Facts):
    """Of `match`."""

    matches: int | None = Field(None, description="Before verification, of the pairs of this run.")
    settled_by: dict[str, int] = Field({}, description="With a cascade: step -> pairs that needed nothing after it.")
    not_settled: int | None = Field(None, description="With a cascade: pairs left with few matches, or gaps.")


class FilterFacts(Facts):
    """Of `filter`: the two-view verification."""

    pairs: dict[str, int] = Field({}, description="State (verified, rejected, not verifiable) -> pairs.")
    verified_matches: int | None = Field(None, description="Matches of the verified pairs.")
    components: list[int] = Field([], description="Sizes of the groups of images that verified pairs connect.")
    weakly_tied: list[str] = Field([], description="Images with few verified matches.")
    unconnected: list[str] = Field([], description="Images with no verified match.")


class AdjustFacts(Facts):
    """Of `adjust`: the bundle adjustment."""

    images: int | None = Field(None, description="Oriented images.")
    points: int | None = Field(None, description="Points in space.")
    track_length: float | None = Field(None, description="Images per point, mean.")
    reprojection_error_px: float | None = Field(None, description="Mean, pixels.")
    sigma_position_m: float | None = Field(None, description="Of the positions, metres, median; null without metres.")
    sigma_angle_deg: float | None = Field(None, description="Of the attitudes, degrees, median.")
    groups: list[dict[str, Any]] = Field(
        [], description="Of each group: positions, flights, mounts, calibration, heights, control; see adjusted.json."
    )
    outside: dict[str, str] = Field({}, description="Images without adjusted pose -> reason.")
    residuals: dict[str, Any] = Field(
        {}, description="Adjusted less given positions and attitudes: rms, median, worst image; see residuals.csv."
    )


class RefineFacts(Facts):
    """Of `refine`: tie points measured anew."""

    keypoints: int | None = Field(None, description="Matched keypoints, without those that stand for their points.")
    measured: int | None = Field(None, description="Those of them that were measured.")
    shift_px: float | None = Field(None, description="By how much they were moved, median, pixels.")


class ConsistencyFacts(Facts):
    """Of `consistency`: the final matches."""

    verified_matches: int | None = Field(None, description="Matches that are exported.")
    dropped_matches: int | None = Field(None, description="Matches that contradict the adjusted block or are unlikely.")
    points: int | None = Field(None, description="Points of the adjusted block.")
    points_left: int | None = Field(None, description="Those of them that the exported matches hold.")
    expected_right: float | None = Field(None, description="Share (0-1) of the exported ones that is right to 3 px.")
    doubtful: list[str] = Field([], description="Images that the block seems to hold in a wrong place.")


class StageOutcome(BaseModel):
    """One stage. items: images or pairs; done: made now; skipped: up to date before."""

    model_config = ConfigDict(extra="forbid")

    items: int
    done: int
    skipped: int
    failed: int
    seconds: float
    facts: Facts


class Orient(StageOutcome):
    facts: OrientFacts


class Pairs(StageOutcome):
    facts: PairsFacts


class Match(StageOutcome):
    facts: MatchFacts


class Filter(StageOutcome):
    facts: FilterFacts


class Refine(StageOutcome):
    facts: RefineFacts


class Adjust(StageOutcome):
    facts: AdjustFacts


class Consistency(StageOutcome):
    facts: ConsistencyFacts


class Stages(BaseModel):
    """The stages that the command has run, in order."""

    model_config = ConfigDict(extra="forbid")

    orient: Orient | None = None
    pairs: Pairs | None = None
    enhance: StageOutcome | None = None
    simulate: StageOutcome | None = None
    extract: StageOutcome | None = None
    match: Match | None = None
    filter: Filter | None = None
    refine: Refine | None = None
    adjust: Adjust | None = None
    consistency: Consistency | None = None
    export: StageOutcome | None = None
    report: StageOutcome | None = None
    steps: dict[str, dict[str, StageOutcome]] = Field({}, description="Of a shard: what its cascade's steps did.")


class Line(BaseModel):
    """What the last line of every command holds. NaN is null."""

    model_config = ConfigDict(extra="forbid")

    exit_code: int = Field(
        description="0: all is done; 1: some images or pairs failed, or the result is bad; 2: settings or arguments; "
        "3: input or workspace; 4: the result is doubtful, with --strict; 130: interrupted."
    )


class Error(Line):
    """Of every command that something has stopped."""

    command: str | None = Field(None, description="The command; missing where none is recognised.")
    error: str = Field(description="What stopped the command, and what to do.")


class Finding(BaseModel):
    """One criterion of the quality of a block."""

    model_config = ConfigDict(extra="forbid")

    what: str = Field(description="Name of the criterion: `reprojection error`, `bowl` ...")
    value: float | None = Field(description="Its figure, null where it is no number.")
    limit: float | None = Field(description="Where doubt begins.")
    level: Literal["good", "doubtful", "bad"]
    sentence: str = Field(description="Both in words and, where it is not good, the remedy.")


class Quality(BaseModel):
    """How good the adjusted block is."""

    model_config = ConfigDict(extra="forbid")

    verdict: Literal["good", "doubtful", "bad"] = Field(description="The worst level of all findings.")
    findings: list[Finding] = Field(description="Of all criteria that could be checked, the worst first.")
    unchecked: list[str] = Field(description="What could not be checked, in words.")


class Outcome(Line):
    """Of `run` and of every stage."""

    command: Literal[
        "run", "orient", "pairs", "enhance", "simulate", "extract", "match", "filter", "adjust", "export", "report"
    ]
    workspace: str = Field(description="Folder of the results.")
    failures: int = Field(description="Images and pairs that failed; failures.csv names them.")
    quality: Quality | None = Field(None, description="After `run` and `adjust`: what their line `result` says.")
    lost: dict[str, str] | None = Field(
        None, description="After `run` and `adjust`: images that the result does not hold -> reason; as in lost.csv."
    )
    stages: Stages = Field(description="What each stage did.")


class Checked(Line):
    """Of `check`."""

    command: Literal["check"]
    warnings: list[str] = Field(description="What a person should look at.")
    failures: int = Field(description="Images that cannot be read.")
    estimate: dict[str, Any] = Field(description="Pairs, seconds, megabytes of memory and disk.")


class Evaluated(Line):
    """Of `evaluate`: the figures of WORK/evaluation/evaluation.json."""

    model_config = ConfigDict(extra="allow")

    command: Literal["evaluate"]
    workspace: str
    truth: str
    truth_kind: Literal["rendered", "reference"]
    images: int
    totals: dict[str, float | None] = Field(description="Correct matches, correctness, recall ... of the whole block.")
    conditions: list[dict[str, Any]] = Field(description="The same by class of view angle, overlap, texture ...")
    consumer: dict[str, Any] = Field(description="Figures of pycolmap's mapping, or why it was not run.")


class Rendered(Line):
    """Of `synth`."""

    model_config = ConfigDict(extra="allow")

    command: Literal["synth"]


class Weights(Line):
    """Of `weights list`, `verify` and `add`."""

    command: Literal["weights list", "weights verify", "weights add"]
    weights: list[str] | dict[str, str] | None = Field(None, description="Names in the folder; verify: name -> state.")
    shipped: list[str] | dict[str, str] | None = Field(None, description="The same of those of the package.")
    name: str | None = Field(None, description="Of the file that was added.")


class Shown(Line):
    """Of `show`: of a workspace, an image, a pair or a file."""

    command: Literal["show"]
    workspace: str | None = None
    images: int | None = None
    pairs: int | None = None
    image: str | None = None
    keypoints: int | None = None
    partners: dict[str, int] | None = Field(None, description="Image -> verified matches.")
    pair: list[str] | None = None
    verified: int | None = Field(None, description="Matches of the pair.")
    state: str | None = Field(None, description="verified, rejected, not verifiable.")
    picture: str | None = Field(None, description="The file that was written.")
    file: str | None = None
    quality: Quality | None = Field(None, description="Of a workspace.")


class Criterion(BaseModel):
    """One thing that two workspaces are compared by."""

    model_config = ConfigDict(extra="forbid")

    what: str
    first: str = Field(description="As it is shown, of the first workspace.")
    second: str
    better: Literal["first", "second", "neither"]


class Compared(Line):
    """Of `compare`; lists have the first workspace's figure and the second's."""

    command: Literal["compare"]
    settings: list[str]
    pairs: list[int]
    verified: list[int]
    matches: list[int]
    better: Literal["first", "second", "neither"] = Field(description="By the first criterion that tells them apart.")
    criteria: list[Criterion] = Field(description="The gravest first.")


class Configured(Line):
    """Of `config`."""

    command: Literal["config"]
    settings: dict[str, Any]


class Choice(BaseModel):
    """A preset or a strategy."""

    model_config = ConfigDict(extra="forbid")

    name: str
    words: str
    default: bool = False


class Listed(Line):
    """Of `list`."""

    command: Literal["list"]
    presets: list[Choice] = []
    families: dict[str, list[Choice]]


class Begun(Line):
    """Of `init`."""

    command: Literal["init"]
    file: str
    found: list[str]


AnyOutcome = Outcome | Checked | Evaluated | Rendered | Weights | Shown | Compared | Configured | Listed | Begun | Error


def schema() -> str:
    """JSON Schema (draft 2020-12) of the line."""
    found = {"title": "aeromatch --json", **TypeAdapter(AnyOutcome).json_schema()}
    return json.dumps(found, indent=1) + "\n"


if __name__ == "__main__":
    sys.stdout.write(schema())
