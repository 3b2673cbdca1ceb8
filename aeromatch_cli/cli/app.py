"""The application: its commands, its top level, and what every command line passes through."""

from __future__ import annotations

import io
import json
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from aeromatch_cli import LOADED_S, __version__
from aeromatch_cli.cli.commands import EXAMPLES, WEIGHTS, evaluate, frames, synth
from aeromatch_cli.cli.look_commands import EXAMPLES as LOOK_EXAMPLES
from aeromatch_cli.cli.look_commands import LOOK
from aeromatch_cli.cli.options import GroupedHelp
from aeromatch_cli.cli.output import ARGUMENTS, STARTED, as_epilog
from aeromatch_cli.cli.stage_commands import COMMAND_HELP, stage_command
from aeromatch_cli.errors import ConfigError


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
                and ("--json" in given or _stated_by_environment())
                and not isinstance(stop.__context__, typer.Exit)
            ):
                typer.echo(json.dumps(_wrong_arguments(stop.__context__) | {"exit_code": stop.code}))
            raise

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **options: Any) -> Any:
        """Keeps the arguments as they were written, for the log file."""
        written = list(args)  # parsing uses them up
        _refuse_empty(written)
        options["obj"] = {**(options.get("obj") or {}), ARGUMENTS: written}
        return super().make_context(info_name, args, *rest, **options)


# Options whose value is a place: an unset variable of a script leaves it empty, and that would be the current folder.
_PLACES = ("workspace", "images", "poses", "cameras", "masks", "gcp", "gcp-marks", "ground", "out", "truth", "log-file")


def _refuse_empty(written: list[str]) -> None:
    """Raises the parser's error for an option of a place with an empty value."""
    for place, word in enumerate(written):
        name, stated, value = word.partition("=")
        after = written[place + 1] if place + 1 < len(written) else None
        if name.startswith("--") and name[2:] in _PLACES and (value if stated else after) == "":
            raise typer.BadParameter(f"{name} is empty: give its value, or leave the option out")


def _stated_by_environment() -> bool:
    """Whether AEROMATCH_JSON asks for a JSON line: words that click takes for yes."""
    return os.environ.get("AEROMATCH_JSON", "").strip().lower() in {"1", "true", "t", "yes", "y", "on"}


def _wrong_arguments(error: BaseException | None) -> dict[str, Any]:
    """error: what the parser raised; its message names the argument, its context the command."""
    message = getattr(error, "format_message", lambda: "wrong arguments; stderr says which")()
    context = getattr(error, "ctx", None)
    known = (
        {}
        if context is None or context.parent is None
        else {"command": context.command_path.removeprefix(f"{context.find_root().command_path} ")}
    )
    return known | {"error": message}


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Verified, evenly spread tie points for aerial image blocks.",
    epilog=as_epilog(
        (
            "aeromatch run --images IMGS --workspace WORK",
            "aeromatch run --help",
        )
    ),
)
weights_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="List, verify and add network weights.")
app.add_typer(weights_app, name="weights")

for _name, (_help, _examples) in COMMAND_HELP.items():
    app.command(_name, cls=GroupedHelp, help=_help, epilog=as_epilog(_examples))(stage_command(_name))
for _name, _look in LOOK.items():
    app.command(_name, cls=GroupedHelp, epilog=as_epilog(LOOK_EXAMPLES[_name]))(_look)
app.command(cls=GroupedHelp, epilog=as_epilog(EXAMPLES["evaluate"]))(evaluate)
app.command(cls=GroupedHelp, epilog=as_epilog(EXAMPLES["synth"]))(synth)
app.command(cls=GroupedHelp, epilog=as_epilog(EXAMPLES["frames"]))(frames)
for _name, (_help, _command) in WEIGHTS.items():
    weights_app.command(_name, help=_help, epilog=as_epilog(EXAMPLES[f"weights {_name}"]))(_command)


@app.callback(invoke_without_command=True)
def top(
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    """Verified, evenly spread tie points for aerial image blocks."""
    if version:
        typer.echo(__version__)
        raise typer.Exit


def main() -> None:
    """Entry point of the `aeromatch` script."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name that the terminal's encoding lacks is no error
    app(obj={STARTED: LOADED_S})
