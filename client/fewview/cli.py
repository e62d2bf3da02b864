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
from fewview.commands.labels import labels
from fewview.commands.lift import lift
from fewview.commands.live import live
from fewview.commands.open_page import open_page
from fewview.commands.report import report
from fewview.commands.run import run
from fewview.commands.stored import COLUMNS, commands_of
from fewview.commands.upload import upload

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="3D from the 2D keypoints of a few uncalibrated cameras.",
)
# Commands of the server, which has its own distribution: they read their options themselves.
OF_SERVER = {
    "serve": "Run the API; with no settings at all also a queue and a worker.",
    "worker": "Run a worker that does what is on the queue: fits and lifts.",
    "precompile": "Compile the server's inner loops ahead, which the first fit else does.",
    "health": "Check whether the API, or a worker, of this machine is working: for containers.",
    "backup": "Copy everything that a deployment holds into a folder, while it runs.",
    "restore": "Fill an empty deployment with a backup.",
    "migrate": "Bring the tables of the records to this version.",
    "prune": "Delete fits and lifts that ended long ago, and what crashes left.",
    "key": "Make, list and revoke the keys that let clients in.",
    "audit": "Print who changed what.",
    "doctor": "Examine a deployment, and print what to do.",
}
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


def _run_of_server(context: typer.Context) -> None:
    command = context.info_name
    found = entry_points(group="fewview.commands", name=str(command))
    if not found:
        sys.exit(f"fewview {command}: the server is not installed: pip install fewview-server")
    (entry,) = found
    entry.load()(command, context.args)


for name, words in OF_SERVER.items():
    app.command(name, help=words, context_settings=ELSEWHERE)(_run_of_server)
for command in (run, convert, upload, fit, cameras, lift, live, export, report, labels, evaluate):
    app.command()(command)
app.command("open")(open_page)
for kind in COLUMNS:
    app.add_typer(commands_of(kind), name=kind)


if __name__ == "__main__":
    main()
