"""``fewview datasets``, ``fits``, ``models``, ``lifts``: what is stored, listed, told, deleted."""

import json
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fewview.commands.talking import AsJson, Url, say, table, talking

if TYPE_CHECKING:
    from fewview.client import Client

# What a line of a list says besides id, name and when it was made.
COLUMNS = {
    "datasets": ("frames", "views", "keypoints"),
    "fits": ("status", "frames", "model_id"),
    "models": ("keypoints", "views", "reprojection_error"),
    "lifts": ("status", "frames", "model_id"),
}
JOBS = ("fits", "lifts")
Identifier = Annotated[str, typer.Argument(metavar="ID")]


def commands_of(kind: str) -> typer.Typer:
    """Return the commands on one kind of what is stored: ``datasets``, ``fits``, ..."""
    one = kind.removesuffix("s")
    app = typer.Typer(no_args_is_help=True, help=f"List, describe and delete {kind}.")

    @app.command("list", help=f"List {kind}, newest first.")
    def list_stored(
        *,
        name: Annotated[str | None, typer.Option(help="Those of this very name.")] = None,
        most: Annotated[int, typer.Option(min=1, help="How many at most.")] = 50,
        url: Url = None,
        as_json: AsJson = False,
    ) -> None:
        with talking(url) as client:
            items = islice(_part(client, kind).list(name=name, limit=min(most, 200)), most)
            told = [item.raw for item in items]
            typer.echo(json.dumps(told) if as_json else _lines(kind, told))

    @app.command(help=f"Describe a {one}.")
    def get(identifier: Identifier, *, url: Url = None, as_json: AsJson = False) -> None:
        with talking(url) as client:
            told = _part(client, kind).get(identifier).raw
            say(told, json.dumps(told, indent=2), as_json=as_json)

    @app.command(help=f"Delete a {one}.")
    def delete(identifier: Identifier, *, url: Url = None, as_json: AsJson = False) -> None:
        with talking(url) as client:
            _part(client, kind).delete(identifier)
            say({"deleted": identifier}, f"deleted {identifier}", as_json=as_json)

    if kind in JOBS:

        @app.command(help=f"Cancel a {one} that is queued or running.")
        def cancel(identifier: Identifier, *, url: Url = None, as_json: AsJson = False) -> None:
            with talking(url) as client:
                told = _part(client, kind).cancel(identifier).raw
                say(told, f"cancelled {identifier}", as_json=as_json)

    return app


def _part(client: "Client", kind: str) -> Any:
    return getattr(client, kind)


def _lines(kind: str, told: list[dict[str, Any]]) -> str:
    if not told:
        return f"no {kind}"
    rows = [["id", "name", "made", *COLUMNS[kind]]]
    for item in told:
        said = [item[column] for column in COLUMNS[kind]]
        made = str(item["created_at"])[:16].replace("T", " ")
        rows.append([item["id"], item["name"], made, *map(_short, said)])
    return table(rows)


def _short(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
