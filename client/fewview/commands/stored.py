"""``fewview datasets``, ``fits``, ``models``, ``lifts``: list, show, change and delete them."""

import json
import sys
from collections.abc import Sequence
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fewview.commands.corrections import correct, list_corrections, undo
from fewview.commands.talking import (
    FAILED,
    AsJson,
    Metadata,
    Tags,
    Url,
    echo,
    fields_in,
    say,
    table,
    talking,
)
from fewview.moments import moment_in

if TYPE_CHECKING:
    from fewview.client import Client

# The columns of a list besides id, name and time of creation.
COLUMNS = {
    "datasets": ("frames", "views", "keypoints", "tags"),
    "fits": ("status", "frames", "model_id", "version", "tags"),
    "models": ("keypoints", "views", "reprojection_error", "version", "tags"),
    "lifts": ("status", "frames", "model_id", "tags"),
}
FILES = {
    "datasets": "the capture of a dataset, an npz file",
    "models": "a model with all that is known of it: .safetensors; its network: .onnx",
    "lifts": "all lifted frames: .jsonl, .npz or .safetensors",
}
JOBS = ("fits", "lifts")
AT_ONCE = 200  # that one request may delete
SHOWN = 20  # of those that are to be deleted
MOMENT = "this date or moment, such as 2026-01-31T09:30:00Z; UTC unless it names another zone."
Output = Annotated[Path, typer.Option("--output", "-o", help="The file to write.")]
Identifier = Annotated[str, typer.Argument(metavar="ID")]
Name = Annotated[str | None, typer.Option(help="Those of this very name.")]
Search = Annotated[
    str | None, typer.Option(help="Those with each of these words in their name or in a tag.")
]
WithTags = Annotated[
    list[str] | None, typer.Option("--tag", help="Those with this tag; may repeat.")
]
WithMetadata = Annotated[
    list[str] | None,
    typer.Option("--metadata", help="Those with this value, such as `subject=M7`; may repeat."),
]
Before = Annotated[str | None, typer.Option(help=f"Those made before {MOMENT}")]
After = Annotated[str | None, typer.Option(help=f"Those made after {MOMENT}")]


def commands_of(kind: str) -> typer.Typer:
    """Return the commands on one kind of what is stored: ``datasets``, ``fits``, ..."""
    app = typer.Typer(no_args_is_help=True, help=f"List, describe, change and delete {kind}.")
    _add_list(app, kind)
    _add_commands_on_one(app, kind)
    _add_delete(app, kind)
    if kind == "models":
        app.command()(upload)
    if kind == "datasets":
        app.command()(correct)
        app.command("corrections")(list_corrections)
        app.command()(undo)
    return app


def upload(
    file: Annotated[Path, typer.Argument(help="A file that `download`, `export` or `run` wrote.")],
    *,
    name: Annotated[str | None, typer.Option(help="Of the model; else that in the file.")] = None,
    tag: Tags = None,
    metadata: Metadata = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Store a model from a file; prints its id."""
    with talking(url) as client:
        fields = fields_in(metadata, "--metadata")
        made = client.models.upload(file, name=name, tags=tag or (), metadata=fields)
        say(made.raw, made.id, as_json=as_json)


def _status_of(kind: str) -> Any:
    """Return the option that chooses by status; what is no job has none, and no such filter."""
    listed = "`queued`, `running`, `succeeded`, `failed` or `cancelled`."
    return Annotated[str | None, typer.Option(help=listed, hidden=kind not in JOBS)]


def _facts_of(kind: str) -> Any:
    """Return the option that gives what is known of a dataset; nothing else has any."""
    known = "What is known of it: fps=50, view_names, image_sizes or skeleton as JSON; may repeat."
    return Annotated[list[str] | None, typer.Option("--set", help=known, hidden=kind != "datasets")]


def _add_list(app: typer.Typer, kind: str) -> None:
    @app.command("list", help=f"List {kind}, newest first.")
    def list_stored(
        *,
        name: Name = None,
        search: Search = None,
        tag: WithTags = None,
        metadata: WithMetadata = None,
        status: _status_of(kind) = None,  # type: ignore[valid-type]
        before: Before = None,
        after: After = None,
        most: Annotated[int, typer.Option(min=1, help="How many at most.")] = 50,
        url: Url = None,
        as_json: AsJson = False,
    ) -> None:
        with talking(url) as client:
            filters = _filters(name, search, tag, metadata, status, before, after)
            items = islice(_part(client, kind).list(**filters, limit=min(most, 200)), most)
            listed = [item.raw for item in items]
            echo(json.dumps(listed) if as_json else _lines(kind, listed))


def _add_commands_on_one(app: typer.Typer, kind: str) -> None:
    one = kind.removesuffix("s")

    @app.command(help=f"Describe a {one}.")
    def get(identifier: Identifier, *, url: Url = None, as_json: AsJson = False) -> None:
        with talking(url) as client:
            listed = _part(client, kind).get(identifier).raw
            say(listed, json.dumps(listed, indent=2), as_json=as_json)

    @app.command(help=f"Change what is known of a {one}; what is not named stays as it is.")
    def change(
        identifier: Identifier,
        *,
        name: Annotated[str | None, typer.Option(help="Its new name.")] = None,
        tag: Tags = None,
        metadata: Metadata = None,
        facts: _facts_of(kind) = None,  # type: ignore[valid-type]
        url: Url = None,
        as_json: AsJson = False,
    ) -> None:
        with talking(url) as client:
            fields = fields_in(metadata, "--metadata") if metadata else None
            labels = {"name": name, "tags": tag or None, "metadata": fields}
            changes = fields_in(facts, "--set") | labels
            listed = _part(client, kind).update(identifier, **changes).raw
            say(listed, f"changed {identifier}", as_json=as_json)

    if kind in FILES:

        @app.command(help=f"Download {FILES[kind]}; what broke off goes on where it was.")
        def download(
            identifier: Identifier, *, output: Output, url: Url = None, as_json: AsJson = False
        ) -> None:
            with talking(url) as client:
                file = str(_part(client, kind).download(identifier, output))
                say({"file": file}, f"wrote {file}", as_json=as_json)

    if kind in JOBS:

        @app.command(help=f"Cancel a {one} that is queued or running.")
        def cancel(identifier: Identifier, *, url: Url = None, as_json: AsJson = False) -> None:
            with talking(url) as client:
                listed = _part(client, kind).cancel(identifier).raw
                say(listed, f"cancelled {identifier}", as_json=as_json)


def _add_delete(app: typer.Typer, kind: str) -> None:
    @app.command(help=f"Delete {kind}: those named, or those that the options choose.")
    def delete(
        identifiers: Annotated[list[str] | None, typer.Argument(metavar="[ID]...")] = None,
        *,
        name: Name = None,
        search: Search = None,
        tag: WithTags = None,
        metadata: WithMetadata = None,
        status: _status_of(kind) = None,  # type: ignore[valid-type]
        before: Before = None,
        after: After = None,
        yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask first.")] = False,
        url: Url = None,
        as_json: AsJson = False,
    ) -> None:
        with talking(url) as client:
            filters = _filters(name, search, tag, metadata, status, before, after)
            if any(filters.values()):
                chosen = _chosen(client, kind, {"id": identifiers, **filters}, ask=not yes)
            elif identifiers:
                chosen = identifiers
            else:
                raise ValueError(f"name the {kind} to delete, or choose them, as with --tag")
            _delete(client, kind, chosen, as_json=as_json)


def _filters(
    name: str | None,
    search: str | None,
    tags: list[str] | None,
    metadata: list[str] | None,
    status: str | None,
    before: str | None,
    after: str | None,
) -> dict[str, Any]:
    return {
        "name": name,
        "search": search,
        "tag": tags or None,
        "metadata": fields_in(metadata, "--metadata") or None,
        "status": status,
        "created_before": _moment("--before", before),
        "created_after": _moment("--after", after),
    }


def _moment(option: str, text: str | None) -> datetime | None:
    try:
        return None if text is None else moment_in(text)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from error


def _chosen(client: "Client", kind: str, filters: dict[str, Any], *, ask: bool) -> list[str]:
    """Return the identifiers to delete, after the user has seen and confirmed them.

    Raises
    ------
    ValueError
        There is no terminal to ask on.
    """
    listed = [item.raw for item in _part(client, kind).list(**filters, limit=AT_ONCE)]
    if ask and listed:
        if not sys.stdin.isatty():
            raise ValueError(f"this would delete {len(listed)} {kind}: give --yes to confirm")
        echo(_lines(kind, listed[:SHOWN]), err=True)
        typer.confirm(f"Delete these {len(listed)} {kind}?", abort=True, err=True)
    return [item["id"] for item in listed]


def _delete(client: "Client", kind: str, identifiers: Sequence[str], *, as_json: bool) -> None:
    """Delete these, and print which could not be deleted; exit status 1 if there are any."""
    deleted: list[str] = []
    refused: list[dict[str, str]] = []
    for start in range(0, len(identifiers), AT_ONCE):
        some = identifiers[start : start + AT_ONCE]
        count = _part(client, kind).would_delete(id=some)
        answer = _part(client, kind).delete_many(id=some, expected_count=count)
        deleted += answer.deleted
        refused += [vars(refusal) for refusal in answer.refused]
    words = f"deleted {', '.join(deleted) or 'nothing'}"
    say({"deleted": deleted, "refused": refused}, words, as_json=as_json)
    for refusal in refused:
        echo(f"fewview: {refusal['id']}: {refusal['detail']}", err=True)
    if refused:
        raise typer.Exit(FAILED)


def _part(client: "Client", kind: str) -> Any:
    return getattr(client, kind)


def _lines(kind: str, listed: list[dict[str, Any]]) -> str:
    if not listed:
        return f"no {kind}"
    rows = [["id", "name", "made", *COLUMNS[kind]]]
    for item in listed:
        fields = [item.get(column) for column in COLUMNS[kind]]
        made = str(item["created_at"])[:16].replace("T", " ")
        rows.append([item["id"], item["name"], made, *map(_short, fields)])
    return table(rows)


def _short(value: Any) -> str:
    if value is None or value == []:
        return "-"
    if isinstance(value, list):
        return " ".join(value)
    return f"{value:.2f}" if isinstance(value, float) else str(value)
