"""The other commands: judge a workspace, render a block, manage network weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aeromatch_cli.cli.options import Jobs, Json, LogFile, ProgressFormat, Quiet
from aeromatch_cli.cli.output import as_texts, guarded
from aeromatch_cli.cli.progress import ProgressKind, progress_shown
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.words import counted

if TYPE_CHECKING:
    from aeromatch_cli.stages.command_result import Result

EXAMPLES: Mapping[str, Sequence[str]] = {
    "evaluate": (
        "aeromatch evaluate WORK --truth BLOCK",
        "aeromatch evaluate WORK --truth REFERENCE --no-mapping --json",
    ),
    "synth": (
        "aeromatch synth OUT --preset suburb --images 12 --seed 0",
        "aeromatch synth OUT --preset city --flight two-flights --size 1000x750 --images 24",
    ),
    "frames": (
        "aeromatch frames DJI_0001.MP4 --out IMGS",
        "aeromatch frames DJI_0001.MP4 --out IMGS --track log.gpx --start 2026-05-01T10:00:00Z --overlap 0.7",
    ),
    "weights list": ("aeromatch weights list", "aeromatch weights list --json"),
    "weights verify": ("aeromatch weights verify", "aeromatch weights verify --json"),
    "weights add": ("aeromatch weights add sift_lightglue.pth", "aeromatch weights add sift_lightglue.safetensors"),
}
# Written out: the modules that know them are too heavy for --help. A test compares.
_SCENES = "city, suburb, farmland, grass, desert, hills, water-edge"
_FLIGHTS = "nadir, oblique, sweep, orbit, arc, two-flights, mixed, cross, two-heights, tilted, dense-rig"


def evaluate(
    context: typer.Context,
    work: Annotated[
        Path,
        typer.Argument(
            metavar="WORK",
            envvar="AEROMATCH_WORKSPACE",
            show_envvar=False,
            help="Workspace that `aeromatch run` wrote.",
        ),
    ],
    truth: Annotated[
        Path,
        typer.Option(
            "--truth", metavar="DIR", help="Rendered block, or folder with poses.csv and block.json of a reference."
        ),
    ],
    mapping: Annotated[bool, typer.Option(help="Also count the images that pycolmap registers (default yes).")] = True,
    log_file: LogFile = None,
    json_: Json = False,
    progress: ProgressFormat = ProgressKind.AUTO,
    quiet: Quiet = False,
) -> None:
    """Evaluate the matches of a workspace against rendered truth or reference poses."""

    def call() -> Result:
        from aeromatch_cli.errors import WorkspaceError
        from aeromatch_cli.evaluate import evaluate_workspace
        from aeromatch_cli.evaluate.output import facts, lines, refresh_report, write_evaluation
        from aeromatch_cli.lab.opening import open_truth
        from aeromatch_cli.stages.command_result import Result

        shown = progress_shown(progress, quiet=quiet)
        evaluation = evaluate_workspace(work, truth, open_truth, mapping=mapping, progress=shown)
        try:
            written = write_evaluation(evaluation)
        except WorkspaceError as error:  # an archive that nobody may write: its figures are no less true
            failure = ("evaluate", str(work), str(error))
            return Result((*lines(evaluation), f"not written: {error}"), facts(evaluation), (failure,))
        end = (f"written to {written[0].parent}", refresh_report(work))
        return Result((*lines(evaluation), *end), facts(evaluation))

    guarded(call, "evaluate", quiet=quiet, as_json=json_, log_file=log_file, context=context)


def frames(
    context: typer.Context,
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="MP4, MOV or AVI.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the pictures and poses.csv.")],
    track: Annotated[
        Path | None,
        typer.Option(
            "--track", metavar="FILE", help="DJI's subtitles (SRT) or a GPX track (default: the one beside the video)."
        ),
    ] = None,
    start: Annotated[
        str, typer.Option("--start", metavar="TIME", help="UTC of the video's first frame, which a GPX track needs.")
    ] = "",
    overlap: Annotated[
        float, typer.Option("--overlap", metavar="SHARE", help="What one picture shows of the one before.")
    ] = 0.8,
    log_file: LogFile = None,
    json_: Json = False,
    progress: ProgressFormat = ProgressKind.AUTO,
    quiet: Quiet = False,
) -> None:
    """Write pictures of a video that overlap as those of a flight do, with a list of their positions."""

    def call() -> Result:
        from aeromatch_cli.executor import Executor
        from aeromatch_cli.stages.command_result import Result
        from aeromatch_cli.stages.frames import write_frames

        with Executor("serial", 1, progress_shown(progress, quiet=quiet)) as executor:
            lines, facts = write_frames(video, out, executor, track=track, start=start, overlap=overlap)
        return Result(tuple(lines), facts)

    guarded(call, "frames", quiet=quiet, as_json=json_, log_file=log_file, context=context)


def synth(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the rendered block.")],
    preset: Annotated[str, typer.Option("--preset", metavar="NAME", help=f"Scene: {_SCENES}.")] = "city",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the scene (default 0).")] = 0,
    size: Annotated[str, typer.Option("--size", metavar="WxH", help="Image size, pixels.")] = "1000x750",
    images: Annotated[int, typer.Option("--images", min=1, help="Number of images.")] = 12,
    flight: Annotated[str, typer.Option("--flight", metavar="NAME", help=f"Flight: {_FLIGHTS}.")] = "nadir",
    height: Annotated[
        float | None,
        typer.Option(
            "--height", metavar="METRES", help="Flying height above ground, metres (default: that of the scene)."
        ),
    ] = None,
    lens: Annotated[
        str,
        typer.Option("--lens", metavar="MODEL", help="Camera model: PINHOLE, RADIAL, OPENCV, BROWN, ..., or real."),
    ] = "SIMPLE_RADIAL",
    sun: Annotated[
        str | None, typer.Option("--sun", metavar="AZIMUTH,ELEVATION", help="Sun of the first flight, degrees.")
    ] = None,
    texture: Annotated[
        Path | None,
        typer.Option("--texture", metavar="DIR", help="Folder of pictures that become the ground's texture."),
    ] = None,
    readout_ms: Annotated[
        float, typer.Option("--readout-ms", min=0.0, help="Rolling shutter: from the first row to the last, ms.")
    ] = 0.0,
    speed: Annotated[
        float, typer.Option("--speed", metavar="M_PER_S", min=0.0, help="Of the aircraft while the rows are read.")
    ] = 0.0,
    jobs: Jobs = None,
    log_file: LogFile = None,
    json_: Json = False,
    progress: ProgressFormat = ProgressKind.AUTO,
    quiet: Quiet = False,
) -> None:
    """Render a block of images with exact truth."""

    def call() -> Result:
        from aeromatch_cli.lab.synthetic import render_block
        from aeromatch_cli.stages.command_result import Result

        width_px, height_px = _parse_size(size)
        summary = render_block(
            out, preset, seed=seed, width_px=width_px, height_px=height_px, images=images, flight=flight,
            lens=lens.upper(), height_m=height, sun_deg=_parse_sun(sun), texture=texture,
            readout_ms=readout_ms, speed_m_s=speed, jobs=jobs or 0, progress=progress_shown(progress, quiet=quiet),
        )  # fmt: skip
        words = f"rendered {counted(images, 'image')} into {out} ({summary.seconds:.0f} s)"
        return Result((words,), as_texts(asdict(summary)))

    guarded(call, "synth", quiet=quiet, as_json=json_, log_file=log_file, context=context)


def _parse_sun(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    azimuth, _, elevation = text.partition(",")
    try:
        return float(azimuth), float(elevation)
    except ValueError:
        raise ConfigError(f"--sun {text!r}: write AZIMUTH,ELEVATION in degrees, for example 135,45") from None


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise ConfigError(f"--size {text!r}: write WIDTHxHEIGHT in pixels, for example 1000x750")
    return int(width), int(height)


def _list_weights(json_: Json = False, quiet: Quiet = False) -> None:
    _manage_weights("list", None, json_, quiet)


def _verify_weights(json_: Json = False, quiet: Quiet = False) -> None:
    _manage_weights("verify", None, json_, quiet)


def _add_weights(
    path: Annotated[str, typer.Argument(metavar="PATH", help="Weights file: .safetensors, .pth or .pt.")],
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    _manage_weights("add", path, json_, quiet)


# `aeromatch weights NAME`: its help and its command.
WEIGHTS: Mapping[str, tuple[str, Callable[..., None]]] = {
    "list": ("List the network weights of the package and of the weights folder.", _list_weights),
    "verify": ("Compare every weights file with its recorded SHA-256.", _verify_weights),
    "add": ("Check a weights file of LightGlue or ALIKED and copy it into the weights folder.", _add_weights),
}


def _manage_weights(action: str, argument: str | None, json_: bool, quiet: bool) -> None:
    def call() -> Result:
        from aeromatch_cli.stages.weights import manage_weights

        return manage_weights(action, argument)

    guarded(call, f"weights {action}", quiet=quiet, as_json=json_, log_file=None)
