"""Tutorials are followed to the letter, with short captures and quick fits.

What is to be run is marked in the documents, in comments that nobody sees:

* ``<!-- run -->``: the commands of the next block, one after the other;
* ``<!-- output -->``: some of what the last of them printed; files that it wrote must be all there;
* ``<!-- save NAME -->``: the next block is a file;
* ``<!-- serve -->``: a command that goes on while the others run.
"""

import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from PIL import Image

from tests import fork_server
from tests.tiers import thorough_after
from worker.process import python

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^<!-- (run|serve|output|save) ?(\S*) -->\n```\w+\n(.*?)^```", re.M | re.S)
PROGRAMS = {"fewview": python("-m", "fewview.cli"), "python": python()}
QUICK = {"steps": 40, "dictionary_sizes": "[16,8]", "batch_size": 16, "distillation": "false"}
FRAMES = "160"  # enough to be sure of how late a camera is
USUAL = "127.0.0.1:8000"  # also of a WebSocket


class Reader:
    """Who follows a document in a folder of their own."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder, self._stack = folder, stack
        self._variables: dict[str, str] = {}
        self._address = USUAL
        self.printed = ""

    def follow(self, document: Path) -> None:
        blocks = BLOCK.findall(document.read_text(encoding="utf-8"))
        assert blocks
        for what, name, text in blocks:
            if what == "save":
                quick = text.replace(USUAL, self._address).replace("frames=60", "frames=12")
                (self.folder / name).write_text(quick)
            elif what == "serve":
                self.serve(text)
            elif what == "output":
                shown = set(re.findall(r"^wrote +(.+)$", text, re.M))
                assert shown == set(re.findall(r"^wrote +(.+)$", self.printed, re.M))
                assert all((self.folder / file).exists() for file in shown)
            else:
                for line in text.splitlines():
                    self.run(line)

    def run(self, line: str) -> None:
        assigned = re.fullmatch(r"(\w+)=\$\((.+)\)", line)
        words = self._words(assigned[2] if assigned else line)
        done = fork_server.run(words, cwd=self.folder, env=self._environment(words))
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        self.printed = done.stdout
        if assigned:
            self._variables[assigned[1]] = done.stdout.strip()

    def serve(self, command: str) -> None:
        self._address = self._stack.enter_context(self._served(command))

    def _words(self, line: str) -> list[str]:
        """Return a command as a shell would, with fewer frames and steps."""
        for name, value in self._variables.items():
            line = line.replace(f"${name}", value)
        program, *words = (word.replace("~/fewview", str(ROOT)) for word in shlex.split(line))
        words = [found for word in words for found in self._found(word)]
        if program == "fewview" and words[0] in {"run", "fit"}:
            words += [part for name in QUICK for part in ("-c", f"{name}={QUICK[name]}")]
        if program == "python" and words[0].endswith("practice.py"):
            words += ["--frames", FRAMES]
        return [*PROGRAMS.get(program, [program]), *words]

    def _found(self, word: str) -> list[str]:
        if "*" not in word:
            return [word]
        found = sorted(str(path.relative_to(self.folder)) for path in self.folder.glob(word))
        assert found, word
        return found

    def _environment(self, words: list[str]) -> dict[str, str]:
        given = {name: value for name, value in os.environ.items() if name[:8] != "FEWVIEW_"}
        if self._address != USUAL:  # else `fewview run` starts a service of its own
            given["FEWVIEW_URL"] = f"http://{self._address}"
        return given

    @contextmanager
    def _served(self, command: str) -> Iterator[str]:
        words = [*self._words(command.strip()), "--port", "0"]
        with fork_server.Popen(
            words,
            cwd=self.folder,
            env=self._environment(words),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as process:
            lines = process.stdout or ()
            try:
                for line in lines:
                    if found := re.search(r"API +http://(\S+)", line):
                        break
                else:
                    pytest.fail(f"{command} did not start")
                yield found[1]
            finally:
                process.terminate()
                list(lines)  # until it has ended


@pytest.mark.parametrize(
    "name", thorough_after(1, ["sleap", "openpose", "deeplabcut", "capture-software"])
)
def test_a_tutorial_works_as_it_is_written(name: str, tmp_path: Path) -> None:
    with ExitStack() as stack:
        Reader(tmp_path, stack).follow(ROOT / "docs" / "tutorials" / f"{name}.md")
    if name == "sleap":
        with Image.open(tmp_path / "mouse.gif") as film:
            film.seek(10)  # raises where it is shorter


def test_the_python_of_the_readme_works(tmp_path: Path) -> None:
    (shown,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    quick = ", ".join(f"{name}={value}" for name, value in QUICK.items()).replace("false", "False")
    whole = "client.datasets.create(capture)"
    assert whole in shown
    (tmp_path / "six_lines.py").write_text(shown.replace(whole, f"{whole}, {quick}"))
    with ExitStack() as stack:
        reader = Reader(tmp_path, stack)
        reader.run("python ~/fewview/examples/practice.py deeplabcut")
        for number, file in enumerate(sorted(tmp_path.glob("*.csv")), start=1):
            file.rename(tmp_path / f"cam{number}.csv")
        reader.serve("fewview serve")
        reader.run("python six_lines.py")
    assert reader.printed.count("[[[") == 2
