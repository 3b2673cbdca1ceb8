"""The commands that take a configuration: `run`, its stages one by one, and `check`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aeromatch_cli import DEFAULT_PRESET
from aeromatch_cli.cli.options import (
    Cameras,
    Config,
    ControlFile,
    ControlMarks,
    ControlPurpose,
    Crs,
    Deep,
    Exclude,
    ExecutorName,
    Ground,
    Images,
    Jobs,
    Json,
    KeepImages,
    LogFile,
    Masks,
    MaxSize,
    Memory,
    Overwrite,
    PoseFormat,
    Poses,
    ProgressFormat,
    Quiet,
    Scheduler,
    Set,
    ShardText,
    Strict,
    Within,
    WorkspaceDir,
)
from aeromatch_cli.cli.output import STARTED, as_texts, guarded, said
from aeromatch_cli.cli.progress import ProgressKind, progress_shown
from aeromatch_cli.errors import ConfigError

if TYPE_CHECKING:
    from aeromatch_cli.config.schema import BlockSettings
    from aeromatch_cli.stages.command_result import Result

# Commands that start anew where no preset is named.
_WHOLE = ("run", "check")
# Option -> the only command that takes it; the others do not show it, and say so.
_OF_ONE_COMMAND = {"deep": "check", "within": "run"}
# Commands that end with a verdict on the block.
_JUDGED = ("run", "adjust")
# Name: what the command does, and examples.
COMMAND_HELP: Mapping[str, tuple[str, Sequence[str]]] = {
    "run": (
        "Do everything, over all overlapping pairs: from the orientation to the report.",
        (
            "aeromatch run --images IMGS",
            "aeromatch run baseline --images IMGS --poses exif --workspace WORK",
            "aeromatch run fusion --images IMGS --poses poses.csv --crs EPSG:32633",
            "aeromatch run oblique --images IMGS --poses poses.csv --set extract.keypoints=12000",
            "aeromatch run --images IMGS --within 20m",
        ),
    ),
    "orient": (
        "Find cameras, poses and terrain of the block from a first pass over reduced images.",
        (
            "aeromatch orient --images IMGS --workspace WORK",
            "aeromatch orient baseline --images IMGS --poses none --set orient=incremental",
        ),
    ),
    "pairs": (
        "Read the block and choose the pairs of images.",
        (
            "aeromatch pairs baseline --images IMGS --poses poses.csv --set pairs.min_overlap=0.2",
            "aeromatch pairs baseline --images IMGS --poses geo.txt --set pairs.max_neighbours=30",
        ),
    ),
    "enhance": (
        "Write the enhanced picture of every image that is enhanced.",
        (
            "aeromatch enhance fusion --images IMGS --poses poses.csv --workspace WORK",
            "aeromatch enhance baseline --images IMGS --set enhance=shadow --workspace WORK",
        ),
    ),
    "simulate": (
        "Write the simulated views of every image.",
        (
            "aeromatch simulate baseline --images IMGS --poses poses.csv --workspace WORK",
            "aeromatch simulate baseline --images IMGS --set simulate=neighbours --workspace WORK",
        ),
    ),
    "extract": (
        "Find keypoints and descriptors in every image.",
        (
            "aeromatch extract baseline --images IMGS --poses poses.csv --shard 1/4",
            "aeromatch extract oblique --images IMGS --set extract.keypoints=6000",
        ),
    ),
    "match": (
        "Match every pair; features that are missing are made first.",
        (
            "aeromatch match baseline --images IMGS --poses poses.csv --shard 1/4",
            "aeromatch match baseline --images IMGS --set match.guided=true",
        ),
    ),
    "filter": (
        "Verify the matches of every pair.",
        (
            "aeromatch filter baseline --images IMGS --poses poses.csv --set filter=poselib+graph",
            "aeromatch filter --workspace WORK",
        ),
    ),
    "adjust": (
        "Measure the verified tie points in the pixels and adjust the oriented block: poses, cameras and points.",
        (
            "aeromatch adjust --workspace WORK",
            "aeromatch adjust --workspace WORK --gcp gcp_list.txt",
        ),
    ),
    "export": (
        "Write the verified matches for other programs.",
        (
            "aeromatch export --workspace WORK",
            "aeromatch export --workspace WORK --set export=colmap+opensfm+geojson",
        ),
    ),
    "report": (
        "Write the HTML report.",
        ("aeromatch report --workspace WORK", "aeromatch report baseline --images IMGS --poses poses.csv"),
    ),
    "check": (
        "Dry run that writes nothing: are images readable, poses plausible, weights present; estimates of pairs, time, "
        "memory and disk.",
        (
            "aeromatch check --images IMGS",
            "aeromatch check fusion --images IMGS --poses poses.csv",
            "aeromatch check --deep WORK",
        ),
    ),
}


def stage_command(name: str) -> Callable[..., None]:
    """The command of one stage, of `run` or of `check`: all take the same options, but those of one alone."""

    def command(
        context: typer.Context,
        config: Config = None,
        images: Images = None,
        poses: Poses = None,
        pose_format: PoseFormat = None,
        cameras: Cameras = None,
        crs: Crs = None,
        ground: Ground = None,
        masks: Masks = None,
        exclude: Exclude = None,
        gcp: ControlFile = None,
        gcp_marks: ControlMarks = None,
        gcp_use: ControlPurpose = None,
        workspace: WorkspaceDir = None,
        set_: Set = None,
        max_size: MaxSize = None,
        jobs: Jobs = None,
        memory: Memory = None,
        executor: ExecutorName = None,
        scheduler: Scheduler = None,
        shard: ShardText = None,
        within: Within = None,
        deep: Deep = False,
        overwrite: Overwrite = False,
        strict: Strict = False,
        keep_images: KeepImages = False,
        log_file: LogFile = None,
        json_: Json = False,
        progress: ProgressFormat = ProgressKind.AUTO,
        quiet: Quiet = False,
    ) -> None:
        block: dict[str, Any] = {"images": images, "poses": poses, "cameras": cameras, "crs": crs, "ground": ground}
        block |= {"pose_format": pose_format, "masks": masks, "max_size_px": max_size}
        block |= {"exclude": ",".join(exclude) if exclude else None}
        block |= {"gcp": gcp, "gcp_marks": gcp_marks, "gcp_use": gcp_use}
        run: dict[str, Any] = {"jobs": jobs, "memory": memory, "keep_images": keep_images or None}
        run |= {"scheduler": scheduler, "executor": executor or ("dask" if scheduler else None)}

        def call() -> Result:
            from aeromatch_cli import graph
            from aeromatch_cli.config import Settings, load
            from aeromatch_cli.stages import deep_check
            from aeromatch_cli.stages.run import execute

            for option, given in (("deep", deep), ("within", within is not None)):
                if given and name != _OF_ONE_COMMAND[option]:
                    raise ConfigError(f"--{option} belongs to `aeromatch {_OF_ONE_COMMAND[option]}`, not to {name}")
            if deep:
                if any(value is not None for value in block.values()):
                    raise ConfigError("--deep looks at a workspace alone: leave out all that is said of the block")
                return deep_check.run(Path(config or workspace or Settings.model_fields["workspace"].default))
            if strict and name not in _JUDGED:
                raise ConfigError(f"--strict is for {' and '.join(_JUDGED)}: {name} does not say how good the block is")
            if scheduler and executor not in (None, "dask"):
                raise ConfigError(f"--scheduler is for --executor dask, not {executor}: leave out one of them")
            recipe, say = _recipe(config, name, workspace), said(quiet)
            if config is not None and recipe != config:
                say(f"settings         {recipe}: as they were asked for before --within reduced them")
            if config is None and recipe == DEFAULT_PRESET:
                say(f"preset           {recipe}, no other is named")
            settings = load(
                recipe,
                set_ or (),
                as_texts(block),
                run=as_texts(run),
                workspace=_absolute(workspace),
            )
            _check_control(block, settings.block)
            course = graph.course(shard=shard is not None) if name == "run" else ()
            shown = progress_shown(progress, quiet=quiet, stages=course)
            return execute(
                name, settings, shard=shard, within=within, started=context.find_root().obj.get(STARTED),
                overwrite=overwrite, progress=shown, say=say,
            )  # fmt: skip

        guarded(call, name, quiet=quiet, as_json=json_, log_file=log_file, context=context, strict=strict)

    every = inspect.signature(command, eval_str=True)
    options = [
        option if _OF_ONE_COMMAND.get(option.name, name) == name else _hidden(option)
        for option in every.parameters.values()
    ]
    command.__signature__ = every.replace(parameters=options)  # type: ignore[attr-defined]
    return command


def _hidden(option: inspect.Parameter) -> inspect.Parameter:
    """The option as it is, but for the help."""
    kind, (described,) = option.annotation.__origin__, option.annotation.__metadata__
    described = copy(described)
    described.hidden = True
    return option.replace(annotation=Annotated[kind, described])


def _check_control(given: Mapping[str, Any], block: BlockSettings) -> None:
    """Raises ConfigError where something is said of control points, and there are none. given: the options, None where
    one is left out."""
    defaults = type(block).model_fields
    idle = [
        f"--{name.replace('_', '-')}"
        for name in ("gcp_marks", "gcp_use")
        if given[name] is not None or getattr(block, name) != defaults[name].default
    ]
    if idle and not block.gcp:
        raise ConfigError(f"{' and '.join(idle)} without control points: name the file that holds them with --gcp")


def _recipe(config: str | None, command: str, workspace: Path | None) -> str:
    """What a command follows that names no preset: the workspace's own settings for single stages, else `auto`.

    A whole run of a workspace, or of its config.yaml, follows the settings that were asked for where `--within` has
    reduced them."""
    from aeromatch_cli.config import Settings
    from aeromatch_cli.workspace import Workspace

    if config is not None:
        path = Path(config)
        asked = Workspace(path.parent if path == Workspace(path.parent).config else path).asked
        return str(asked) if command in _WHOLE and asked.is_file() else config
    own = Workspace(Path(workspace or Settings.model_fields["workspace"].default)).config
    return str(own) if command not in _WHOLE and own.is_file() else DEFAULT_PRESET


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(path.absolute())
