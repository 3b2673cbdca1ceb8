"""The options that commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Config = Annotated[
    str | None,
    typer.Argument(
        metavar="CONFIG|PRESET",
        help="Preset (auto, baseline, fusion, polar, oblique), or a YAML file. Default: auto; for a single stage the "
        "settings that the workspace has.",
    ),
]
Images = Annotated[
    Path | None,
    typer.Option(
        "--images",
        metavar="DIR",
        envvar="AEROMATCH_IMAGES",
        show_envvar=False,
        help="Folder of images, searched recursively.",
    ),
]
Poses = Annotated[
    str | None,
    typer.Option(
        "--poses",
        metavar="FILE|exif|none",
        envvar="AEROMATCH_POSES",
        show_envvar=False,
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
        help="Masks in COLMAP naming, 0 = ignore; or one mask.",
    ),
]
ControlFile = Annotated[
    Path | None,
    typer.Option(
        "--gcp",
        metavar="FILE",
        envvar="AEROMATCH_GCP",
        show_envvar=False,
        help="Ground control points (ODM's gcp_list.txt) to compare the result with.",
    ),
]
WorkspaceDir = Annotated[
    Path | None,
    typer.Option(
        "--workspace",
        metavar="DIR",
        envvar="AEROMATCH_WORKSPACE",
        show_envvar=False,
        help="Folder for every result (default aeromatch-work).",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, as extract.keypoints=12000; repeatable."),
]
MaxSize = Annotated[
    int | None,
    typer.Option(
        "--max-size",
        min=1,
        metavar="PX",
        envvar="AEROMATCH_MAX_SIZE",
        show_envvar=False,
        help="Reduce larger images to this longer side, pixels.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", min=0, envvar="AEROMATCH_JOBS", show_envvar=False, help="Worker processes (default 0: one per core)."
    ),
]
ExecutorName = Annotated[
    str | None,
    typer.Option(
        "--executor",
        metavar="serial|processes|dask",
        envvar="AEROMATCH_EXECUTOR",
        show_envvar=False,
        help="Where tasks run (default processes).",
    ),
]
ShardText = Annotated[
    str | None, typer.Option("--shard", metavar="I/N", help="Only part I of N of the images and pairs, 1 <= I <= N.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Make every result again, even if it is up to date.")]
KeepImages = Annotated[
    bool, typer.Option("--keep-images", help="Keep enhanced and simulated pictures in the workspace.")
]
LogFile = Annotated[
    Path | None,
    typer.Option(
        "--log-file",
        metavar="FILE",
        envvar="AEROMATCH_LOG_FILE",
        show_envvar=False,
        help="Append every message, with time, to this file.",
    ),
]
Json = Annotated[
    bool,
    typer.Option(
        "--json", envvar="AEROMATCH_JSON", show_envvar=False, help="Print a JSON object as the last line of stdout."
    ),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        envvar="AEROMATCH_QUIET",
        show_envvar=False,
        help="Print only errors, no summary and no progress.",
    ),
]
