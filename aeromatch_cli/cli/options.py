"""The options that commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from aeromatch_cli.cli.progress import ProgressKind

# Groups of options in every help.
_BLOCK, _RESULTS, _WORK, _MESSAGES = "Block", "Results and settings", "How it runs", "Messages"


class GroupedHelp(TyperCommand):
    """A command whose help has its options in groups, as plain text: its own first, --help last."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for param in self.get_params(ctx):
            own = "Arguments" if param.param_type_name == "argument" else "Options"
            group = _MESSAGES if param.name == "help" else getattr(param, "rich_help_panel", None) or own
            record = param.get_help_record(ctx)
            if record is not None:
                groups.setdefault(group, []).append(record)
        for heading, records in groups.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


Config = Annotated[
    str | None,
    typer.Argument(
        metavar="CONFIG|PRESET",
        help="Preset (auto, baseline, fusion, polar, oblique), a YAML file, or a workspace, whose settings are taken. "
        "Default: auto; for a single stage the settings that the workspace has.",
    ),
]
Images = Annotated[
    str | None,
    typer.Option(
        "--images",
        metavar="DIR|URL|ZIP",
        envvar="AEROMATCH_IMAGES",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Folder of images, searched recursively; or a URL (s3://, gs://, https://), or a zip archive.",
    ),
]
Poses = Annotated[
    str | None,
    typer.Option(
        "--poses",
        metavar="FILE|exif|none",
        envvar="AEROMATCH_POSES",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Pose file of any program, or GPS and XMP angles (default exif).",
    ),
]
PoseFormat = Annotated[
    str | None,
    typer.Option(
        "--pose-format",
        metavar="NAME",
        envvar="AEROMATCH_POSE_FORMAT",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Format of the pose file (default auto: by its content); see docs/input.md.",
    ),
]
Cameras = Annotated[
    str | None,
    typer.Option(
        "--cameras",
        metavar="FILE|exif|folder",
        envvar="AEROMATCH_CAMERAS",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Camera file, EXIF (default), or one camera per folder.",
    ),
]
Crs = Annotated[
    str | None,
    typer.Option(
        "--crs",
        metavar="CODE",
        envvar="AEROMATCH_CRS",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="World frame: EPSG:32633, local, or auto (UTM zone; default).",
    ),
]
Ground = Annotated[
    str | None,
    typer.Option(
        "--ground",
        metavar="METRES|DEM|auto",
        envvar="AEROMATCH_GROUND",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Ground height, DEM file, or auto (default).",
    ),
]
Masks = Annotated[
    Path | None,
    typer.Option(
        "--masks",
        metavar="DIR|FILE",
        envvar="AEROMATCH_MASKS",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Masks in COLMAP naming, 0 = ignore; or one mask.",
    ),
]
Exclude = Annotated[
    list[str] | None,
    typer.Option(
        "--exclude",
        metavar="NAME|PATTERN|FILE",
        rich_help_panel=_BLOCK,
        help="Leave images out: a name, a pattern, or a file with one of these in each line; repeatable.",
    ),
]
ControlFile = Annotated[
    Path | None,
    typer.Option(
        "--gcp",
        metavar="FILE",
        envvar="AEROMATCH_GCP",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Ground control points: ODM's gcp_list.txt, or a file of Pix4D or Metashape.",
    ),
]
ControlMarks = Annotated[
    Path | None,
    typer.Option(
        "--gcp-marks",
        metavar="FILE",
        envvar="AEROMATCH_GCP_MARKS",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Their image measurements where these stand in a file of their own.",
    ),
]
ControlPurpose = Annotated[
    str | None,
    typer.Option(
        "--gcp-use",
        metavar="adjust|check",
        envvar="AEROMATCH_GCP_USE",
        show_envvar=False,
        rich_help_panel=_BLOCK,
        help="Use control points for the fit (default), or all as check points.",
    ),
]
WorkspaceDir = Annotated[
    Path | None,
    typer.Option(
        "--workspace",
        metavar="DIR",
        envvar="AEROMATCH_WORKSPACE",
        show_envvar=False,
        rich_help_panel=_RESULTS,
        help="Folder for every result (default aeromatch-work).",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        rich_help_panel=_RESULTS,
        help="Change a setting, as extract.keypoints=12000; repeatable.",
    ),
]
MaxSize = Annotated[
    int | None,
    typer.Option(
        "--max-size",
        min=1,
        metavar="PX",
        envvar="AEROMATCH_MAX_SIZE",
        show_envvar=False,
        rich_help_panel=_RESULTS,
        help="Reduce larger images to this longer side, pixels.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        min=0,
        max=1024,
        envvar="AEROMATCH_JOBS",
        show_envvar=False,
        rich_help_panel=_WORK,
        help="Worker processes (default 0: one per core).",
    ),
]
Memory = Annotated[
    str | None,
    typer.Option(
        "--memory",
        metavar="8GB",
        envvar="AEROMATCH_MEMORY",
        show_envvar=False,
        rich_help_panel=_WORK,
        help="Memory for all workers together; fewer workers start where more would need more (default: no limit).",
    ),
]
ExecutorName = Annotated[
    str | None,
    typer.Option(
        "--executor",
        metavar="serial|processes|dask",
        envvar="AEROMATCH_EXECUTOR",
        show_envvar=False,
        rich_help_panel=_WORK,
        help="Where tasks run (default processes).",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        envvar="AEROMATCH_SCHEDULER",
        show_envvar=False,
        rich_help_panel=_WORK,
        help="Dask scheduler to use, such as tcp://10.0.0.1:8786 (sets --executor dask).",
    ),
]
ShardText = Annotated[
    str | None,
    typer.Option(
        "--shard",
        metavar="I/N",
        rich_help_panel=_WORK,
        help="Only part I of N of the images and pairs; not for check, adjust, export, report.",
    ),
]
Within = Annotated[
    str | None,
    typer.Option(
        "--within",
        metavar="DURATION",
        rich_help_panel=_WORK,
        help="End in this time (20m, 1h, 90s). Where all would take longer, the report page is left out, then steps, "
        "the measuring of tie points, and pixels and keypoints are fewer.",
    ),
]
Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", rich_help_panel=_RESULTS, help="Make every result again, even if it is up to date."),
]
Deep = Annotated[
    bool,
    typer.Option(
        "--deep",
        rich_help_panel=_RESULTS,
        help="Compare every file of a workspace with its checksum, in place of all other checks: check --deep WORK.",
    ),
]
Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        rich_help_panel=_RESULTS,
        help="End with exit code 4 where the result is doubtful (run, adjust); where it is bad the code is 1 anyway.",
    ),
]
KeepImages = Annotated[
    bool,
    typer.Option(
        "--keep-images", rich_help_panel=_RESULTS, help="Keep enhanced and simulated pictures in the workspace."
    ),
]
LogFile = Annotated[
    Path | None,
    typer.Option(
        "--log-file",
        metavar="FILE",
        envvar="AEROMATCH_LOG_FILE",
        show_envvar=False,
        rich_help_panel=_MESSAGES,
        help="Append every message, with time, to this file.",
    ),
]
Json = Annotated[
    bool,
    typer.Option(
        "--json",
        envvar="AEROMATCH_JSON",
        show_envvar=False,
        rich_help_panel=_MESSAGES,
        help="Print a JSON object as the last line of stdout.",
    ),
]
ProgressFormat = Annotated[
    ProgressKind,
    typer.Option(
        "--progress",
        envvar="AEROMATCH_PROGRESS",
        show_envvar=False,
        rich_help_panel=_MESSAGES,
        help="json: a JSON object per line on stderr; auto: a bar on a terminal, plain lines elsewhere.",
    ),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        envvar="AEROMATCH_QUIET",
        show_envvar=False,
        rich_help_panel=_MESSAGES,
        help="Print only errors, lost images and a result that is not good.",
    ),
]
