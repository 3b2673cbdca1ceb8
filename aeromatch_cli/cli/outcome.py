"""What `--json` prints as the last line of stdout, as a schema.

To bring the file up to date: `python -m aeromatch_cli.cli.outcome > docs/outcome.schema.json`.
"""

from __future__ import annotations

import json
import sys
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class Facts(BaseModel):
    """Figures of a stage; further ones may be there, and docs/workspace.md has them all (`reports/<stage>.json`)."""

    model_config = ConfigDict(extra="allow")


class OrientFacts(Facts):
    """Of `orient`: what the pictures say of the poses."""

    poses_from: str | None = Field(None, description="Where the poses of the block come from, in words.")
    frame: Literal["world", "own"] | None = Field(None, description="own: no position was given; metres mean nothing.")
    wrong_attitudes: dict[str, float] = Field({}, description="image_id -> degrees off.")
    wrong_positions: dict[str, float] = Field({}, description="image_id -> metres off.")
    outside: list[str] = Field([], description="Images that the pictures could not orient.")


class PairsFacts(Facts):
    """Of `pairs`: the block as it was read."""

    images: int | None = Field(None, description="Images of the block.")
    summary: list[str] = Field([], description="What is printed of the block, line by line.")
    block: dict[str, Any] = Field({}, description="The same in figures: crs, gsd_m, flying_height_m, pairs ...")
    warnings: list[str] = Field([], description="What a person should look at.")


class MatchFacts(Facts):
    """Of `match`."""

    matches: int | None = Field(None, description="Before verification, of the pairs of this run.")
    settled_by: dict[str, int] = Field({}, description="With a cascade: step -> pairs that needed nothing after it.")
    not_settled: int | None = Field(None, description="With a cascade: pairs left with fewer matches than promised.")


class FilterFacts(Facts):
    """Of `filter`: the two-view verification."""

    pairs: dict[str, int] = Field({}, description="State (verified, rejected, not verifiable) -> pairs.")
    verified_matches: int | None = Field(None, description="Matches of the verified pairs.")
    components: list[int] = Field([], description="Sizes of the groups of images that verified pairs connect.")
    weakly_tied: list[str] = Field([], description="Images with few verified matches.")


class AdjustFacts(Facts):
    """Of `adjust`: the bundle adjustment."""

    images: int | None = Field(None, description="Oriented images.")
    points: int | None = Field(None, description="Points in space.")
    track_length: float | None = Field(None, description="Images per point, mean.")
    reprojection_error_px: float | None = Field(None, description="Mean, pixels.")
    sigma_position_m: float | None = Field(None, description="Standard deviation of the positions, metres, median.")
    sigma_angle_deg: float | None = Field(None, description="Of the attitudes, degrees, median.")
    outside: dict[str, str] = Field({}, description="Images without adjusted pose -> reason.")


class ConsistencyFacts(Facts):
    """Of `consistency`: the final matches."""

    verified_matches: int | None = Field(None, description="Matches that are exported.")
    dropped_matches: int | None = Field(None, description="Matches that the adjusted block contradicts.")
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
    adjust: Adjust | None = None
    consistency: Consistency | None = None
    export: StageOutcome | None = None
    report: StageOutcome | None = None


class Outcome(BaseModel):
    """The last line of stdout of `aeromatch run` and of every stage with --json. NaN is null."""

    model_config = ConfigDict(extra="forbid", title="aeromatch --json")

    command: str | None = Field(None, description="The command; missing where the arguments cannot be parsed.")
    exit_code: int = Field(description="0: all is done; 1: some images or pairs failed; 2: settings or arguments; 3: "
                           "input or workspace; 130: interrupted.")  # fmt: skip
    error: str | None = Field(None, description="What stopped the command; then there are no stages.")
    workspace: str | None = Field(None, description="Folder of the results.")
    failures: int | None = Field(None, description="Images and pairs that failed; failures.csv names them.")
    stages: Stages | None = Field(None, description="What each stage did.")


def schema() -> str:
    """JSON Schema (draft 2020-12) of the line."""
    return json.dumps(Outcome.model_json_schema(), indent=1) + "\n"


if __name__ == "__main__":
    sys.stdout.write(schema())
