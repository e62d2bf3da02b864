"""``fewview key`` and ``fewview audit``."""

from pathlib import Path

import pytest

from tests.service.process.test_keeping import run


def test_keys_are_made_listed_and_revoked(tmp_path: Path) -> None:
    folder = {"FEWVIEW_DATA_DIR": str(tmp_path / "data")}  # which is not there yet
    made = run("key", "create", "room 3", "--scopes=lift,read", "--project=gait", **folder)
    assert made.status == 0
    token = made.stdout.strip()
    (line,) = run("key", "list", **folder).stdout.splitlines()
    identifier = line.split()[0]
    assert identifier in made.stderr
    assert all(word in line for word in ("in force", "gait", "read,lift", "room 3"))
    assert token.encode() not in (tmp_path / "data" / "records.db").read_bytes()
    assert run("key", "revoke", identifier, **folder).status == 0
    assert "revoked" in run("key", "list", **folder).stdout
    found = run("audit", **folder).stdout.splitlines()
    assert [line.split()[4] for line in found] == ["key.revoke", "key.create"]
    assert all(identifier in line for line in found)
    assert len(run("audit", "--limit=1", **folder).stdout.splitlines()) == 1
    past = run("prune", "--keep-audit-days=0", **folder)
    assert past.status == 0
    assert run("audit", **folder).stdout == ""


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        ((), 2, "usage: fewview key create NAME"),
        (("make",), 2, "usage: fewview key create NAME"),
        (("create", "x", "--scopes=all"), 2, "expected some of read, lift, write, delete, admin"),
        (("create", "x", "--project=A b"), 2, "--project"),
        (("create", "x", "--expires-in-days=-1"), 2, "--expires-in-days"),
        (("revoke", "key_none"), 1, "There is no key 'key_none'"),
    ],
)
def test_keys_that_cannot_be_made_or_revoked(
    tmp_path: Path, words: tuple[str, ...], status: int, message: str
) -> None:
    folder = {"FEWVIEW_DATA_DIR": str(tmp_path)}
    assert run("key", "create", "first", **folder).status == 0
    ended = run("key", *words, **folder)
    assert ended.status == status
    assert message in ended.stderr
