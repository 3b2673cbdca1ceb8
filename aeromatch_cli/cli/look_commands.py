"""The commands that look: at a workspace, at two, at settings and what can be chosen; and `init`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aeromatch_cli import DEFAULT_PRESET
from aeromatch_cli.cli.options import Config, Images, Json, Quiet, Set
from aeromatch_cli.cli.output import guarded
from aeromatch_cli.errors import ConfigError

if TYPE_CHECKING:
    from aeromatch_cli.stages.command_result import Result

EXAMPLES: Mapping[str, Sequence[str]] = {
    "show": (
        "aeromatch show WORK",
        "aeromatch show WORK DJI_0001.JPG --views --out DJI_0001.html",
        "aeromatch show WORK DJI_0001.JPG DJI_0002.JPG --rejected",
        "aeromatch show WORK DJI_0001.JPG DJI_0002.JPG --out pair.gif",
    ),
    "compare": ("aeromatch compare WORK1 WORK2", "aeromatch compare WORK1 WORK2 --json"),
    "config": ("aeromatch config", "aeromatch config fusion --set extract.keypoints=12000"),
    "list": ("aeromatch list", "aeromatch list match"),
    "init": ("aeromatch init --images IMGS", "aeromatch init block.yaml --images IMGS"),
}


def show(
    context: typer.Context,
    path: Annotated[
        Path | None,
        typer.Argument(
            metavar="WORK|FILE",
            help="Workspace, or a .npz, .json or .csv file of one; may be left out where AEROMATCH_WORKSPACE is set.",
        ),
    ] = None,
    images: Annotated[
        list[str] | None, typer.Argument(metavar="[IMAGE [IMAGE]]", help="One image, or the two of a pair.")
    ] = None,
    rejected: Annotated[bool, typer.Option("--rejected", help="Draw the matches that were dropped, too.")] = False,
    views: Annotated[
        bool, typer.Option("--views", help="Of an image: also its enhanced picture, masks and views.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="FILE.png (default: in the folder WORK/show), FILE.html, or of a pair FILE.gif, which lays one image "
            "on the other in turns.",
        ),
    ] = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Show a workspace, an image, a pair or a file, in words and as a picture."""

    def call() -> Result:
        from aeromatch_cli.config import Settings
        from aeromatch_cli.report.show import show as shown
        from aeromatch_cli.report.tiles import SUFFIXES
        from aeromatch_cli.stages.command_result import Result

        names = images or []
        given = os.environ.get("AEROMATCH_WORKSPACE")
        root = path or Path(given or Settings().workspace)
        if path is not None and given and not _is_shown(path):
            # The first word is an image of the workspace that the environment names, perhaps in the images' folder.
            root, names = Path(given), [str(path), *names]
        if len(names) > 2:
            raise ConfigError(f"{len(names)} images: name one, or the two of a pair")
        wanted = SUFFIXES if len(names) == 2 else SUFFIXES[:2]
        if out is not None and out.suffix.lower() not in wanted:
            raise ConfigError(f"--out {out}: name it {' or '.join(f'FILE{suffix}' for suffix in wanted)}")
        found = shown(root, names, out, rejected=rejected, views=views)
        return Result(tuple(found.lines), found.facts)

    guarded(call, "show", quiet=quiet, as_json=json_, log_file=None, context=context)


def _is_shown(path: Path) -> bool:
    """Whether it is a workspace or a file of one."""
    return path.is_dir() or (path.is_file() and path.suffix.lower() in (".npz", ".json", ".csv"))


def compare(
    context: typer.Context,
    first: Annotated[Path, typer.Argument(metavar="WORK1", help="Workspace.")],
    second: Annotated[Path, typer.Argument(metavar="WORK2", help="Another workspace of the same block.")],
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare two workspaces of the same images: settings, pairs, matches, time, and which is better."""

    def call() -> Result:
        from aeromatch_cli.report.compare import compare as compared
        from aeromatch_cli.stages.command_result import Result

        lines, facts = compared(first, second)
        return Result(tuple(lines), facts)

    guarded(call, "compare", quiet=quiet, as_json=json_, log_file=None, context=context)


def config(
    context: typer.Context,
    source: Config = None,
    set_: Set = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Print all settings of a preset or YAML file."""

    def call() -> Result:
        from aeromatch_cli.config import load
        from aeromatch_cli.config.overview import whole_settings
        from aeromatch_cli.stages.command_result import Result

        tree = load(source or DEFAULT_PRESET, set_ or ()).model_dump(mode="json")
        return Result(tuple(whole_settings(tree).splitlines()), {"settings": tree})

    guarded(call, "config", quiet=quiet, as_json=json_, log_file=None, context=context)


def list_(
    context: typer.Context,
    family: Annotated[
        str, typer.Argument(metavar="[FAMILY]", help="presets, or a family of strategies such as match.")
    ] = "",
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """List presets and strategies, one line each."""

    def call() -> Result:
        from aeromatch_cli.config.overview import choices, listing
        from aeromatch_cli.stages.command_result import Result

        return Result(tuple(listing(family)), choices(family))

    guarded(call, "list", quiet=quiet, as_json=json_, log_file=None, context=context)


def init(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="[FILE]", help="Settings file to write.")] = Path("aeromatch.yaml"),
    images: Images = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a commented settings file for a folder of images."""

    def call() -> Result:
        from aeromatch_cli.config.overview import first_settings
        from aeromatch_cli.files import write_text
        from aeromatch_cli.images.remote import is_remote
        from aeromatch_cli.stages.command_result import Result

        if images is None:
            raise ConfigError("no images: give --images DIR")
        if out.exists():
            raise ConfigError(f"{out} exists and is not replaced: give another name, or delete it")
        if is_remote(images):
            raise ConfigError(f"init looks at a folder of this machine, not at {images}: write the file by hand")
        text, found = first_settings(Path(images), out.absolute().parent)
        write_text(out, text)
        return Result((*found, f"written to {out}: aeromatch run {out}"), {"file": str(out), "found": found})

    guarded(call, "init", quiet=quiet, as_json=json_, log_file=None, context=context)


LOOK: Mapping[str, Callable[..., None]] = {
    "show": show,
    "compare": compare,
    "config": config,
    "list": list_,
    "init": init,
}
