"""The token in the data folder: one for all, of one user, and closed to others."""

import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from store import access_token
from store.errors import StoreError

ROOT = Path(__file__).parents[2]
AT_ONCE = """
import sys
from collections.abc import Callable
from pathlib import Path
from store import access_token
print("ready", flush=True)
sys.stdin.readline()
for folder in sys.argv[1:]:
    print(access_token.ensure(Path(folder)))
"""


def test_a_token_is_made_once_and_is_its_users_alone(tmp_path: Path) -> None:
    folder = tmp_path / "to be" / "made"
    token = access_token.ensure(folder)
    assert re.fullmatch(r"fewview_[A-Za-z0-9_-]{43}", token)
    assert access_token.ensure(folder) == token
    assert access_token.ensure(tmp_path) != token
    (file,) = folder.iterdir()  # and nothing else
    assert file.name == "token"
    assert file.read_text() == f"{token}\n"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_lax_umask_opens_nothing(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        access_token.ensure(tmp_path / "data")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "data" / "token").stat().st_mode) == 0o600


def test_processes_that_make_it_at_once_agree(tmp_path: Path) -> None:
    folders = [tmp_path / str(number) for number in range(200)]
    makers = [
        subprocess.Popen(
            [sys.executable, "-c", AT_ONCE, *map(str, folders)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(3)
    ]
    for maker in makers:
        assert maker.stdout is not None
        assert maker.stdout.readline() == "ready\n"
    for maker in makers:
        assert maker.stdin is not None
        maker.stdin.write("go\n")
        maker.stdin.flush()
    made = [maker.communicate()[0].split() for maker in makers]
    assert len(set(made[0])) == len(folders)
    assert made[0] == made[1] == made[2]
    assert {path.name for folder in folders for path in folder.iterdir()} == {"token"}


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o666, 0o610])
def test_a_token_that_others_may_touch_is_refused(tmp_path: Path, mode: int) -> None:
    token = access_token.ensure(tmp_path)
    file = tmp_path / "token"
    file.chmod(mode)
    with pytest.raises(StoreError) as refused:
        access_token.ensure(tmp_path)
    assert f"chmod 600 {file}" in str(refused.value)
    assert token not in str(refused.value)
    file.chmod(0o600)
    assert access_token.ensure(tmp_path) == token


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_token_of_another_user_is_refused(tmp_path: Path) -> None:
    access_token.ensure(tmp_path)
    os.chown(tmp_path / "token", 12345, 12345)
    with pytest.raises(StoreError, match="another user"):
        access_token.ensure(tmp_path)


@pytest.mark.parametrize(
    "content", ["", "fewview_", "x" * 40, "fewview_" + "ü" * 43, "fewview_" + "a" * 42 + " "]
)
def test_what_is_no_token_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "token"
    file.touch(mode=0o600)
    file.write_text(content)
    with pytest.raises(StoreError, match="holds no token: delete it"):
        access_token.ensure(tmp_path)
    file.unlink()
    assert access_token.ensure(tmp_path)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    """A link may lead to a file of somebody else's, and nobody may ever write into a pipe."""
    kinds: tuple[Callable[[Path], object], ...] = (
        lambda path: path.symlink_to("/etc/hostname"),
        lambda path: path.symlink_to(tmp_path / "nowhere"),
        os.mkfifo,
        Path.mkdir,
    )
    for number, put in enumerate(kinds):
        folder = tmp_path / str(number)
        folder.mkdir()
        put(folder / "token")
        with pytest.raises(StoreError, match=rf"{folder / 'token'} is .*: delete it"):
            access_token.ensure(folder)
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="cannot be used"):
        access_token.ensure(tmp_path / "file")
