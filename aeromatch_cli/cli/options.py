"""The options that commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Config = Annotated[str, typer.Argument(metavar="CONFIG|PRESET", help="YAML file or preset name.")]

Images = Annotated[Path | None, typer.Option("--images", metavar="DIR", help="Folder of images.")]

Poses = Annotated[str | None, typer.Option("--poses", metavar="FILE|exif|none", help="Pose list, or EXIF/XMP.")]

Cameras = Annotated[str | None, typer.Option("--cameras", metavar="FILE|exif|folder", help="Cameras, or grouping.")]

Crs = Annotated[str | None, typer.Option("--crs", metavar="CODE", help="World frame, EPSG:32633 or local.")]

Ground = Annotated[str | None, typer.Option("--ground", metavar="METRES|DEM|auto", help="Ground height.")]

Masks = Annotated[Path | None, typer.Option("--masks", metavar="DIR|FILE", help="Masks in COLMAP naming.")]

WorkspaceDir = Annotated[Path | None, typer.Option("--workspace", metavar="DIR", help="Folder for every result.")]

Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a setting; repeatable.")]

MaxSize = Annotated[int | None, typer.Option("--max-size", min=1, metavar="PX", help="Reduce larger images to this.")]

Jobs = Annotated[int | None, typer.Option("--jobs", min=0, help="Worker processes; 0 = one per core.")]

ExecutorName = Annotated[
    str | None, typer.Option("--executor", metavar="serial|processes|dask", help="Where tasks run.")
]

ShardText = Annotated[str | None, typer.Option("--shard", metavar="I/N", help="Only part I of N of the items.")]

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Do everything again, whatever is up to date.")]

KeepImages = Annotated[bool, typer.Option("--keep-images", help="Keep enhanced and simulated pictures.")]

LogFile = Annotated[Path | None, typer.Option("--log-file", metavar="FILE", help="Append every message to this file.")]

Json = Annotated[bool, typer.Option("--json", help="Last line of stdout is a JSON object.")]

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Only errors on stderr, no summary.")]
