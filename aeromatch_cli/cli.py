"""Every command: parse, one call, print. Results go to stdout, messages to stderr, errors become exit codes.

0 all done; 1 finished, but some items failed (listed); 2 bad arguments or configuration; 3 nothing usable;
130 interrupted (run the same command again: it resumes).
"""

from __future__ import annotations

import io
import json
import math
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from aeromatch_cli import __version__
from aeromatch_cli.cli.log import RecordedProgress, logged_to, record
from aeromatch_cli.errors import AeromatchError, ConfigError

if TYPE_CHECKING:
    from aeromatch_cli.stages.run import Result

EXIT_SOME_FAILED = 1
EXIT_INTERRUPTED = 130
_ARGUMENTS = "aeromatch.arguments"


class _Commands(TyperGroup):
    """Gives wrong arguments a JSON line too, where --json asks for one: scripts read the last line whatever happens."""

    def main(self, *args: Any, **options: Any) -> Any:
        stated = args[0] if args else options.get("args")
        given = sys.argv[1:] if stated is None else list(stated)
        try:
            return super().main(*args, **options)
        except SystemExit as stop:
            # Commands leave by typer.Exit and have said it already; what else exits with 2 is the parser.
            if (
                stop.code == ConfigError.exit_code
                and "--json" in given
                and not isinstance(stop.__context__, typer.Exit)
            ):
                facts = {"error": "wrong arguments; stderr says which", "exit_code": stop.code}
                typer.echo(json.dumps(facts))
            raise

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **options: Any) -> Any:
        """Keeps the arguments as they were written, for the log file."""
        written = list(args)  # parsing uses them up
        options["obj"] = {_ARGUMENTS: written}
        return super().make_context(info_name, args, *rest, **options)


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Verified, evenly spread tie points for aerial image blocks.",
    epilog="CONFIG|PRESET is a YAML file or the name of a preset; every command names its options with --help.",
)
weights_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="List, verify and add network weights.")
app.add_typer(weights_app, name="weights")

STAGES = {
    "run": "Everything, over all overlapping pairs: pairs to report.",
    "pairs": "Read the block and choose the pairs.",
    "enhance": "Write enhanced pictures; none of images that enhance.one_sun_minutes spares, none with enhance=none.",
    "simulate": "Write simulated views.",
    "extract": "Find features in every image.",
    "match": "Match every pair; features that are missing are made first.",
    "filter": "Verify the matches of every pair.",
    "export": "Write the files of other programs.",
    "report": "Write the HTML report.",
    "check": "Dry run: images readable, poses plausible, weights present, pairs, memory, disk, time. Writes nothing.",
}

# Written out: the modules that know them are too heavy for --help. A test compares.
_SCENES = "city, suburb, farmland, grass, desert, hills, water-edge"
_FLIGHTS = "nadir, oblique, sweep, orbit, two-flights, mixed"

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


def _add_stage_command(name: str, help_text: str) -> None:
    @app.command(name, help=help_text)
    def command(
        context: typer.Context,
        config: Config,
        images: Images = None,
        poses: Poses = None,
        cameras: Cameras = None,
        crs: Crs = None,
        ground: Ground = None,
        masks: Masks = None,
        workspace: WorkspaceDir = None,
        set_: Set = None,
        max_size: MaxSize = None,
        jobs: Jobs = None,
        executor: ExecutorName = None,
        shard: ShardText = None,
        overwrite: Overwrite = False,
        keep_images: KeepImages = False,
        log_file: LogFile = None,
        json_: Json = False,
        quiet: Quiet = False,
    ) -> None:
        block: dict[str, Any] = {"images": images, "poses": poses, "cameras": cameras, "crs": crs, "ground": ground}
        block |= {"masks": masks, "max_size_px": max_size}
        run = {"jobs": jobs, "executor": executor, "keep_images": keep_images or None}

        def call() -> Result:
            from aeromatch_cli.config import load
            from aeromatch_cli.stages.run import execute

            settings = load(config, set_ or (), _texts(block), run=_texts(run), workspace=_absolute(workspace))
            return execute(name, settings, shard=shard, overwrite=overwrite, progress=_progress(quiet))

        _guard(call, name, quiet=quiet, as_json=json_, log_file=log_file, arguments=_arguments(context))


for _name, _help in STAGES.items():
    _add_stage_command(_name, _help)


@app.command()
def evaluate(
    context: typer.Context,
    work: Annotated[Path, typer.Argument(metavar="WORK", help="Workspace that `run` wrote.")],
    truth: Annotated[Path, typer.Option("--truth", metavar="DIR", help="Rendered block, or reference solution.")],
    mapping: Annotated[bool, typer.Option(help="Also count the images that pycolmap's mapping registers.")] = True,
    log_file: LogFile = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Judge the matches of a workspace against rendered truth or reference poses."""

    def call() -> Result:
        from aeromatch_cli.evaluate import evaluate_workspace
        from aeromatch_cli.evaluate.output import facts, lines, refresh_report, write_evaluation
        from aeromatch_cli.stages.run import Result

        evaluation = evaluate_workspace(work, truth, mapping=mapping, progress=_progress(quiet))
        written = write_evaluation(evaluation)
        end = (f"written to {written[0].parent}", refresh_report(work))
        return Result((*lines(evaluation), *end), facts(evaluation))

    _guard(call, "evaluate", quiet=quiet, as_json=json_, log_file=log_file, arguments=_arguments(context))


@app.command()
def synth(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the rendered block.")],
    preset: Annotated[str, typer.Option("--preset", metavar="NAME", help=f"Scene: {_SCENES}.")] = "city",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another seed gives another scene.")] = 0,
    size: Annotated[str, typer.Option("--size", metavar="WxH", help="Image size in pixels.")] = "1000x750",
    images: Annotated[int, typer.Option("--images", min=1, help="Number of images.")] = 12,
    flight: Annotated[str, typer.Option("--flight", metavar="NAME", help=f"{_FLIGHTS}.")] = "nadir",
    height: Annotated[
        float | None, typer.Option("--height", metavar="METRES", help="Flying height; each scene has its own.")
    ] = None,
    lens: Annotated[
        str, typer.Option("--lens", metavar="MODEL", help="Camera model, COLMAP's name: PINHOLE, RADIAL, OPENCV ...")
    ] = "SIMPLE_RADIAL",
    sun: Annotated[
        str | None, typer.Option("--sun", metavar="AZIMUTH,ELEVATION", help="Sun of the first sortie, degrees.")
    ] = None,
    texture: Annotated[
        Path | None, typer.Option("--texture", metavar="DIR", help="Pictures to lay over the ground.")
    ] = None,
    jobs: Jobs = None,
    log_file: LogFile = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render a block with exact truth."""

    def call() -> Result:
        from aeromatch_cli.stages.run import Result
        from aeromatch_cli.synthetic import render_block

        width_px, height_px = _parse_size(size)
        summary = render_block(
            out, preset, seed=seed, width_px=width_px, height_px=height_px, images=images, flight=flight,
            lens=lens.upper(), height_m=height, sun_deg=_parse_sun(sun), texture=texture, jobs=jobs or 0,
            progress=_progress(quiet),
        )  # fmt: skip
        return Result((f"rendered {images} images into {out} ({summary.seconds:.0f} s)",), _texts(asdict(summary)))

    _guard(call, "synth", quiet=quiet, as_json=json_, log_file=log_file, arguments=_arguments(context))


def _parse_sun(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    azimuth, _, elevation = text.partition(",")
    try:
        return float(azimuth), float(elevation)
    except ValueError:
        raise ConfigError(f"--sun {text!r}: write AZIMUTH,ELEVATION in degrees, for example 135,45") from None


def _add_weights_command(action: str, help_text: str, *, takes_path: bool) -> None:
    def call(argument: str | None, json_: bool, quiet: bool) -> None:
        def work() -> Result:
            from aeromatch_cli.stages.weights import manage_weights

            return manage_weights(action, argument)

        _guard(work, f"weights {action}", quiet=quiet, as_json=json_, log_file=None)

    if takes_path:

        @weights_app.command(action, help=help_text)
        def with_path(
            path: Annotated[str, typer.Argument(metavar="PATH", help="Checkpoint file.")],
            json_: Json = False,
            quiet: Quiet = False,
        ) -> None:
            call(path, json_, quiet)

    else:

        @weights_app.command(action, help=help_text)
        def plain(json_: Json = False, quiet: Quiet = False) -> None:
            call(None, json_, quiet)


_add_weights_command("list", "Weights that strategies find by name.", takes_path=False)
_add_weights_command("verify", "Compare every file with its recorded SHA-256.", takes_path=False)
_add_weights_command("add", "Check a checkpoint strictly and copy it into the weights folder.", takes_path=True)


@app.callback(invoke_without_command=True)
def top(
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    """Verified, evenly spread tie points for aerial image blocks."""
    if version:
        typer.echo(__version__)
        raise typer.Exit


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise ConfigError(f"--size {text!r}: write WIDTHxHEIGHT in pixels, for example 1000x750")
    return int(width), int(height)


def _texts(values: dict[str, Any]) -> dict[str, Any]:
    """Given options only, paths as text."""
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if v is not None}


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(path.absolute())


def _progress(quiet: bool) -> Any:
    from aeromatch_cli.executor import SilentProgress

    if quiet:
        return RecordedProgress(SilentProgress())
    return RecordedProgress(TerminalProgress() if sys.stderr.isatty() else LineProgress())


def _arguments(context: typer.Context) -> Sequence[str]:
    return tuple(context.find_root().obj[_ARGUMENTS])


def _guard(
    call: Callable[[], Result],
    command: str,
    *,
    quiet: bool,
    as_json: bool,
    log_file: Path | None,
    arguments: Sequence[str] = (),
) -> None:
    """Run one command; print its result, or its error, and leave with the right exit code."""
    started = time.monotonic()
    with ExitStack() as stack:

        def logged() -> Result:
            stack.enter_context(logged_to(log_file, quiet=quiet))
            record.info("aeromatch %s: aeromatch %s", __version__, shlex.join(arguments))
            with _terminated_like_interrupt():
                return call()

        facts: dict[str, Any] = {"command": command} | _outcome(logged, quiet=quiet)
        record.info("exit code %d after %.1f s", facts["exit_code"], time.monotonic() - started)
    if as_json:
        typer.echo(json.dumps(_finite(facts), allow_nan=False))
    if facts["exit_code"]:
        raise typer.Exit(int(facts["exit_code"]))


def _outcome(call: Callable[[], Result], *, quiet: bool) -> dict[str, Any]:
    """The facts of one call, with its exit code; its lines, or its error, are printed and recorded."""
    try:
        result = call()
    except AeromatchError as error:
        typer.echo(f"error: {error}", err=True)
        record.error("error: %s", error)
        record.debug("stopped by", exc_info=True)
        return {"error": str(error), "exit_code": error.exit_code}
    except KeyboardInterrupt:
        typer.echo("interrupted; run the same command again to resume", err=True)
        record.error("interrupted")
        return {"error": "interrupted", "exit_code": EXIT_INTERRUPTED}
    except Exception as error:  # noqa: BLE001 - recorded: a defect must not look like exit code 1, "some items failed"
        frame = traceback.extract_tb(error.__traceback__)[-1]
        text = f"unexpected {type(error).__name__} in {Path(frame.filename).name}:{frame.lineno}: {error}"
        typer.echo(f"error: {text}; this is a defect of aeromatch, --log-file FILE keeps its traceback", err=True)
        record.error("error: %s", text, exc_info=True)
        return {"error": text, "exit_code": AeromatchError.exit_code}
    for line in result.lines:
        record.info("%s", line)
        if not quiet:
            typer.echo(line)
    return result.facts | {"exit_code": EXIT_SOME_FAILED if result.failures else 0}


def _finite(value: Any) -> Any:
    """JSON knows no NaN: it becomes null."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def _terminated_like_interrupt() -> Iterator[None]:
    """SIGTERM (a scheduler's time limit) stops as cleanly as Ctrl-C."""

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class LineProgress:
    """One plain line per ten percent, for logs and cron."""

    def start(self, label: str, total: int) -> None:
        self._label, self._total, self._count, self._shown = label, total, 0, 0
        self._started = time.monotonic()

    def advance(self) -> None:
        self._count += 1
        percent = 100 * self._count // max(self._total, 1)
        if percent // 10 > self._shown // 10:
            self._shown = percent
            elapsed = time.monotonic() - self._started
            left = elapsed / self._count * (self._total - self._count)
            typer.echo(f"{self._label}: {percent} % ({self._count}/{self._total}), {left:.0f} s left", err=True)

    def stop(self) -> None:
        """Nothing to clean up."""


class TerminalProgress:
    """A bar with counts and time left."""

    def __init__(self) -> None:
        self._bar: Any = None

    def start(self, label: str, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=Console(stderr=True))
        self._task = self._bar.add_task(label, total=total)
        self._bar.start()

    def advance(self) -> None:
        self._bar.advance(self._task)

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def main() -> None:
    """Entry point of the `aeromatch` script."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name that the terminal's encoding lacks is no error
    app()


if __name__ == "__main__":
    main()
