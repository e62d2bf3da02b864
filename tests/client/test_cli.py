"""The command line, as a process."""

import subprocess
import sys
from pathlib import Path


def run(*words: str) -> "subprocess.CompletedProcess[str]":
    script = Path(sys.executable).with_name("fewview")
    return subprocess.run([script, *words], capture_output=True, text=True, check=False)


def test_commands_are_listed_and_versions_said() -> None:
    shown = run("--help")
    assert shown.returncode == 0
    assert "serve" in shown.stdout
    assert run("--version").stdout.startswith("fewview ")
    assert run("fit-it").returncode == 2


def test_the_server_reads_its_own_options() -> None:
    assert "--redis-url" in run("serve", "--help").stdout
    refused = run("worker", "--frobnicate")
    assert refused.returncode == 2
    assert "frobnicate" in refused.stderr
