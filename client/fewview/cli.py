"""The ``fewview`` command."""

import sys
from importlib.metadata import entry_points, version
from typing import Annotated

import typer

from fewview.commands.cameras import cameras
from fewview.commands.convert import convert
from fewview.commands.evaluate import evaluate
from fewview.commands.export import export
from fewview.commands.fit import fit
from fewview.commands.lift import lift
from fewview.commands.run import run
from fewview.commands.stored import COLUMNS, commands_of
from fewview.commands.upload import upload

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="3D from the 2D keypoints of a few cameras that nobody calibrated.",
)
# Commands of the server, which has its own distribution: they read their options themselves.
ELSEWHERE = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


def main() -> None:
    """Run the command line: exit status 0, 1 for what failed, 2 for what was asked wrongly."""
    app()


@app.callback(invoke_without_command=True)
def _options(
    *, show_version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False
) -> None:
    if show_version:
        typer.echo(f"fewview {version('fewview')}")
        raise typer.Exit


@app.command(context_settings=ELSEWHERE)
def serve(context: typer.Context) -> None:
    """Run the API; with no settings at all also a queue and a worker."""
    _run_of_server("serve", context.args)


@app.command(context_settings=ELSEWHERE)
def worker(context: typer.Context) -> None:
    """Run a worker that fits what is on the queue."""
    _run_of_server("worker", context.args)


@app.command(context_settings=ELSEWHERE)
def precompile(context: typer.Context) -> None:
    """Compile the server's inner loops ahead, which the first fit else does."""
    _run_of_server("precompile", context.args)


@app.command(context_settings=ELSEWHERE)
def backup(context: typer.Context) -> None:
    """Copy everything that a deployment holds into a folder, while it runs."""
    _run_of_server("backup", context.args)


@app.command(context_settings=ELSEWHERE)
def restore(context: typer.Context) -> None:
    """Fill an empty deployment with a backup."""
    _run_of_server("restore", context.args)


@app.command(context_settings=ELSEWHERE)
def migrate(context: typer.Context) -> None:
    """Bring the tables of the records to this version."""
    _run_of_server("migrate", context.args)


@app.command(context_settings=ELSEWHERE)
def prune(context: typer.Context) -> None:
    """Delete fits and lifts that ended long ago, and what crashes left."""
    _run_of_server("prune", context.args)


@app.command(context_settings=ELSEWHERE)
def doctor(context: typer.Context) -> None:
    """Examine a deployment, and say what to do."""
    _run_of_server("doctor", context.args)


for command in (run, convert, upload, fit, cameras, lift, export, evaluate):
    app.command()(command)
for kind in COLUMNS:
    app.add_typer(commands_of(kind), name=kind)


def _run_of_server(command: str, arguments: list[str]) -> None:
    found = entry_points(group="fewview.commands", name=command)
    if not found:
        sys.exit(f"fewview {command}: the server is not installed: pip install fewview-server")
    (entry,) = found
    entry.load()(command, arguments)


if __name__ == "__main__":
    main()
