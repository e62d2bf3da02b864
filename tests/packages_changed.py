"""Print the tests of the packages that were changed since the main branch, for `make check`.

A change in `models/bundle/` is tested by `tests/models/bundle/`, one in `store/` by `tests/store/`;
a changed test alone.
"""

import subprocess
from pathlib import Path

TESTS = Path(__file__).parent
ROOT = TESTS.parent
MAIN = ("origin/main", "main")  # the first that there is; without any, the last commit


def git(*words: str) -> list[str]:
    """Return the output of git in lines; nothing if it fails."""
    ran = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return ran.stdout.splitlines() if ran.returncode == 0 else []


def changed_files() -> list[Path]:
    """Return the files that differ from where this branch left the main branch, new ones too."""
    bases = [base for name in MAIN for base in git("merge-base", "HEAD", name)]
    names = git("diff", "--name-only", bases[0] if bases else "HEAD", "--")
    return [Path(name) for name in names + git("ls-files", "--others", "--exclude-standard")]


def where_tested(file: Path) -> Path | None:
    """Return the tests of a file of the project: a file or a folder, None for documents."""
    if file.parts[0] == "tests":
        here = ROOT / file
        is_test = file.name.startswith("test_")
        if file.suffix != ".py" or (is_test and not here.exists()):
            return None
        return here if is_test else here.parent  # what tests share
    for folder in file.parents[:-1]:
        if (TESTS / folder).is_dir():
            return TESTS / folder
    return None


def main() -> None:
    """Print the paths of the tests, relative to the project."""
    found = {where_tested(file) for file in changed_files()} - {None}
    print(*sorted(str(path.relative_to(ROOT)) for path in found if path is not None))


if __name__ == "__main__":
    main()
