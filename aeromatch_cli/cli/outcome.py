"""What `--json` prints as the last line of stdout, as a schema.

To bring the file up to date: `python -m aeromatch_cli.cli.outcome > docs/outcome.schema.json`.
"""

from __future__ import annotations

import json
import sys
from functools import reduce
from operator import or_
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, create_model

from aeromatch_cli import graph


class StageOutcome(BaseModel):
    """One stage. items: images or pairs; done: made now; skipped: up to date before. result: null where the stage has
    found nothing, such as where no orientation is asked for."""

    model_config = ConfigDict(extra="forbid")

    items: int
    done: int
    skipped: int
    failed: int
    seconds: float
    result: Any


def _stages() -> type[BaseModel]:
    """The stages that a command has run, in order; `steps`: what the steps of a shard's cascade did."""
    fields: dict[str, Any] = {"steps": (dict[str, dict[str, StageOutcome]], {})}
    for stage in graph.STAGES:
        result: Any = (stage.result | None, ...)
        fields[stage.name] = (create_model(stage.name.capitalize(), __base__=StageOutcome, result=result) | None, None)
    return create_model("Stages", __config__=ConfigDict(extra="forbid"), **fields)


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
    left_out: list[str] | None = Field(None, description="After `run --within`: what it did without.")
    stages: Any = Field(description="What each stage did.")


class Checked(Line):
    """Of `check`."""

    command: Literal["check"]
    warnings: list[str] = Field(description="What a person should look at.")
    failures: int = Field(description="Images that cannot be read.")
    estimate: dict[str, Any] = Field(description="Pairs, seconds, megabytes of memory and disk.")


class DeepChecked(Line):
    """Of `check --deep`."""

    command: Literal["check"]
    workspace: str
    files: int
    megabytes: float
    without_checksum: list[str] = Field(description="Files of which nothing says how they were written.")
    damaged: dict[str, str] = Field(description="File -> reason.")


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
    packages: list[str] | None = Field(None, description="Published ones that installed packages hold.")
    not_found: list[str] | None = Field(None, description="Published ones that are nowhere.")
    name: str | None = Field(None, description="Of the file that was added.")


class Shown(Line):
    """Of `show`: of a workspace, an image, a pair or a file."""

    command: Literal["show"]
    workspace: str | None = None
    images: int | None = None
    pairs: int | None = None
    left_out: list[str] | None = Field(None, description="Of a workspace: what `run --within` did without.")
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


def any_outcome() -> TypeAdapter[Any]:
    """What the line of any command is checked by."""
    stages = (_stages(), Field(description="What each stage did."))
    outcome = create_model("Outcome", __base__=Outcome, stages=stages)
    kinds = (
        outcome,
        Checked,
        DeepChecked,
        Evaluated,
        Rendered,
        Weights,
        Shown,
        Compared,
        Configured,
        Listed,
        Begun,
        Error,
    )
    return TypeAdapter(reduce(or_, kinds))


def schema() -> str:
    """JSON Schema (draft 2020-12) of the line."""
    found = {"title": "aeromatch --json", **any_outcome().json_schema()}
    return json.dumps(found, indent=1) + "\n"


if __name__ == "__main__":
    sys.stdout.write(schema())
