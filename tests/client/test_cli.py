"""The command line, as a process."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from fewview import cli

from service.cli import COMMANDS
from tests import fork_server
from tests.processes import free_port
from worker.process import python


def run(*words: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    return fork_server.run(python("-m", "fewview.cli", *words), env=os.environ | environment)


def run_script(*words: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Do the same from nothing, as users start it."""
    script = Path(sys.executable).with_name("fewview")
    return subprocess.run(
        [script, *words],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_commands_are_listed_and_versions_said() -> None:
    shown = run_script("--help")
    assert shown.returncode == 0
    for command in COMMANDS:  # of the server
        assert f" {command} " in shown.stdout
    assert run("--version").stdout.startswith("fewview ")
    assert run("fit-it").returncode == 2


def numbers(command: Any) -> Iterator[Any]:
    """Yield the options of a command, and of those below it, that are numbers with a point."""
    for each in getattr(command, "commands", {}).values():
        yield from numbers(each)
    for option in command.params:
        if option.type.name.startswith("float") and option.name != "min_confidence":
            yield option  # that one is checked by the readers


def test_every_number_that_is_asked_for_is_a_number() -> None:
    """A range lets nan through, and an animation of that is nan."""
    command: Any = typer.main.get_command(cli.app)
    options, context = list(numbers(command)), typer.Context(command)
    assert len(options) >= 8
    for option in options:
        assert option.process_value(context, "1") == 1
        for text in ("nan", "inf"):
            with pytest.raises(typer.BadParameter):
                option.process_value(context, text)


def test_the_server_reads_its_own_options() -> None:
    assert "--redis-url" in run("serve", "--help").stdout
    refused = run("worker", "--frobnicate")
    assert refused.returncode == 2
    assert "frobnicate" in refused.stderr


def test_a_redis_that_is_away_is_said_at_once(tmp_path: Path) -> None:
    url = f"redis://user:secret@127.0.0.1:{free_port()}/0"
    for command in ("worker", "serve"):
        begun = time.monotonic()
        refused = run(command, f"--redis-url={url}", f"--data-dir={tmp_path}")
        assert refused.returncode == 2
        assert refused.stdout == ""
        assert refused.stderr.count("\n") == 1, refused.stderr
        assert refused.stderr.startswith(f"fewview {command}: Redis at redis://***@127.0.0.1:")
        assert "--redis-url" in refused.stderr
        assert "secret" not in refused.stderr
        assert time.monotonic() - begun < 60  # most of it to load the libraries, on a busy machine
    missing = run("worker", f"--data-dir={tmp_path}", FEWVIEW_REDIS_URL="")
    assert missing.returncode == 2


def test_shells_complete_commands_and_options() -> None:
    def completed(*words: str) -> list[str]:
        asked = {
            "_FEWVIEW_COMPLETE": "complete_bash",
            "COMP_WORDS": " ".join(words),
            "COMP_CWORD": str(len(words) - 1),
        }
        return run_script(**asked).stdout.split()

    assert completed("fewview", "da") == ["datasets"]
    assert "delete" in completed("fewview", "fits", "de")
    assert completed("fewview", "fits", "list", "--met") == ["--metadata"]
    shown = subprocess.run(  # which takes the shell that it runs in
        ["/bin/bash", "-c", f"'{Path(sys.executable).with_name('fewview')}' --show-completion; :"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "_FEWVIEW_COMPLETE=complete_bash" in shown.stdout
