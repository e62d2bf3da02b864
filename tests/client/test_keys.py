"""The key of a client: where it is found, whom it reaches, and that nobody else sees it."""

import asyncio
import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import fewview
import pytest
from fewview import AsyncClient, Client
from typer.testing import CliRunner

from tests.client.conftest import Served
from tests.client.hearing import Heard, heard, hearing_streams
from tests.processes import free_port
from worker.process import tied

GIVEN, IN_VARIABLE, IN_FILE = (f"fewview_{letter * 43}" for letter in "GVF")
NOBODY = 65534
# Listens as another user, and prints what came.
LISTENER = """
import os, socket, sys
uid = int(sys.argv[1])
os.setgroups([]), os.setresgid(uid, uid, uid), os.setresuid(uid, uid, uid)
listener = socket.socket()
listener.bind(("127.0.0.1", 0))
listener.listen()
print(listener.getsockname()[1], flush=True)
connection, _ = listener.accept()
came = b""
while b"\\r\\n\\r\\n" not in came:
    came += connection.recv(4096)
connection.sendall(b"HTTP/1.1 503 away\\r\\nContent-Length: 0\\r\\n\\r\\n")
print("authorization" in came.decode().lower(), flush=True)
"""


@pytest.fixture
def server() -> Iterator[Heard]:
    with heard() as found:
        yield found


@pytest.fixture(autouse=True)
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Work in an empty folder, with nothing in the environment."""
    for name in [*os.environ]:
        if name.startswith("FEWVIEW_") or name.lower().endswith("_proxy"):
            monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put_token(folder: Path, text: str = f"{IN_FILE}\n") -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "token"
    file.touch(mode=0o600)
    file.write_text(text)
    return file


def asked(url: str, key: str | None = None, **more: Any) -> None:
    with Client(url, key, patience=0, **more) as client:
        client.health.version()


def asked_async(url: str, key: str | None = None, **more: Any) -> None:
    async def ask() -> None:
        async with AsyncClient(url, key, patience=0, **more) as client:
            await client.health.version()

    asyncio.run(ask())


ASKING = [asked, asked_async]
Ask = Callable[..., None]


def url_of(server: Heard, host: str = "127.0.0.1") -> str:
    return f"http://{host}:{server.port}"


@pytest.mark.parametrize("ask", ASKING)
def test_the_key_is_given_or_in_the_environment_or_in_the_data_folder(
    server: Heard, ask: Ask, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    url = url_of(server)
    ask(url)
    put_token(tmp_path / "fewview-data")
    ask(url)
    put_token(tmp_path / "elsewhere", "fewview_elsewhere")
    monkeypatch.setenv("FEWVIEW_DATA_DIR", "elsewhere")
    ask(url)
    monkeypatch.setenv("FEWVIEW_KEY", f" {IN_VARIABLE}\n")
    ask(url)
    ask(url, GIVEN)
    ask(url, "")
    monkeypatch.setenv("FEWVIEW_KEY", "")
    ask(url)
    found = [None, IN_FILE, "fewview_elsewhere", IN_VARIABLE, GIVEN, None, "fewview_elsewhere"]
    assert server.keys == [key and f"Bearer {key}" for key in found]


def test_a_token_that_is_made_later_is_found(server: Heard, tmp_path: Path) -> None:
    with Client(url_of(server)) as client:
        client.health.version()
        os.chdir("/")
        put_token(tmp_path / "fewview-data")
        client.health.version()
        put_token(tmp_path / "fewview-data", "fewview_another")
        client.health.version()
    assert server.keys == [None, f"Bearer {IN_FILE}", "Bearer fewview_another"]


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "[::1]", "[::ffff:127.0.0.1]"])
def test_every_name_of_this_machine_has_the_token(host: str, tmp_path: Path) -> None:
    put_token(tmp_path / "fewview-data")
    with heard("::1" if host == "[::1]" else "127.0.0.1") as server:
        asked(url_of(server, host))
    assert server.keys == [f"Bearer {IN_FILE}"]


@pytest.mark.parametrize("ask", ASKING)
def test_the_token_in_the_folder_stays_on_this_machine(
    server: Heard, ask: Ask, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """And no proxy sees it, or anything that is for this machine."""
    put_token(tmp_path / "fewview-data")
    with heard() as proxy:
        for name in ("http_proxy", "all_proxy"):
            monkeypatch.setenv(name, url_of(proxy))
        for host in ("lab.example", "127.0.0.1.lab.example", "a.localhost", "10.0.0.1"):
            ask(f"http://{host}")
        assert proxy.keys == [None] * 4
        ask(url_of(server))
        assert server.keys == [f"Bearer {IN_FILE}"]
        ask("http://lab.example", GIVEN)
        assert proxy.keys == [*[None] * 4, f"Bearer {GIVEN}"]


@pytest.mark.parametrize("spoilt", ["open", "a link", "a pipe", "a folder", "no key", "long"])
def test_what_is_no_token_closed_to_others_is_not_sent(
    server: Heard, tmp_path: Path, spoilt: str
) -> None:
    file = put_token(tmp_path / "fewview-data")
    match spoilt:
        case "open":
            file.chmod(0o604)
        case "no key":
            file.write_text("two words\n")
        case "long":
            file.write_text("ä" * 10_000)
        case _:
            file.rename(tmp_path / "moved")
            if spoilt == "a link":
                file.symlink_to(tmp_path / "moved")
            elif spoilt == "a pipe":
                os.mkfifo(file)
            else:
                file.mkdir()
    asked(url_of(server))
    assert server.keys == [None]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users")
@pytest.mark.parametrize(("uid", "shown"), [(0, True), (NOBODY, False)])
def test_another_user_who_listens_in_place_of_the_service_is_shown_no_token(
    tmp_path: Path, uid: int, shown: bool
) -> None:
    put_token(tmp_path / "fewview-data")
    command = tied(sys.executable, "-c", LISTENER, str(uid))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as listener:
        assert listener.stdout is not None
        port = int(listener.stdout.readline())
        with pytest.raises(fewview.Unavailable):
            asked(f"http://localhost:{port}")
        assert listener.stdout.readline() == f"{shown}\n"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_root_shows_the_token_of_a_user_to_that_users_service(tmp_path: Path) -> None:
    os.chown(put_token(tmp_path / "fewview-data"), NOBODY, NOBODY)
    command = tied(sys.executable, "-c", LISTENER, str(NOBODY))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as listener:
        assert listener.stdout is not None
        port = int(listener.stdout.readline())
        with pytest.raises(fewview.Unavailable):
            asked(f"http://127.0.0.1:{port}")
        assert listener.stdout.readline() == "True\n"


@pytest.mark.parametrize("ask", ASKING)
def test_an_authorization_of_ones_own_takes_the_place_of_the_key(
    server: Heard, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FEWVIEW_KEY", IN_VARIABLE)
    ask(url_of(server), headers={"authorization": "Basic b3duOm93bg=="})
    ask(f"http://own:own@127.0.0.1:{server.port}")
    assert server.keys == ["Basic b3duOm93bg=="] * 2
    with pytest.raises(ValueError, match="only one"):
        ask(url_of(server), GIVEN, headers={"Authorization": "Basic b3duOm93bg=="})


@pytest.mark.parametrize("ask", ASKING)
@pytest.mark.parametrize("key", ["two words", "sch\u00f6n", "a\nb", "a\r\nX-B: c", "\0", "a\x7fb"])
def test_a_key_that_no_header_can_hold_is_refused(
    ask: Ask, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match=r"^key: .*fewview key create") as refused:
        ask("http://127.0.0.1:1", key)
    assert key not in str(refused.value)
    if "\0" in key:
        return
    monkeypatch.setenv("FEWVIEW_KEY", key)
    with pytest.raises(ValueError, match=r"^FEWVIEW_KEY: ") as refused:
        ask("http://127.0.0.1:1")
    assert key not in str(refused.value)


@pytest.mark.parametrize("ask", ASKING)
@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_the_key_follows_no_redirect(server: Heard, ask: Ask, status: int) -> None:
    with heard() as other:
        server.status, server.headers = status, {"Location": f"{url_of(other)}/version"}
        with pytest.raises(fewview.ApiError):
            ask(url_of(server), GIVEN)
        assert server.keys == [f"Bearer {GIVEN}"]
        assert other.keys in ([], [None])


# --- streams --------------------------------------------------------------------------------------


def streamed(url: str, key: str | None = None) -> None:
    with Client(url, key, patience=0) as client, client.stream("mdl_any"):
        pass


def streamed_async(url: str, key: str | None = None) -> None:
    async def stream() -> None:
        async with AsyncClient(url, key, patience=0) as client, client.stream("mdl_any"):
            pass

    asyncio.run(stream())


STREAMING = [streamed, streamed_async]


@pytest.mark.parametrize("stream", STREAMING)
def test_the_handshake_of_a_stream_has_the_key(
    stream: Ask, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    put_token(tmp_path / "fewview-data")
    monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{free_port()}")  # nobody is there
    with hearing_streams(lambda: (HTTPStatus.NOT_FOUND, {}, "{}")) as (port, keys):
        for key in (None, GIVEN, ""):
            with pytest.raises(fewview.NotFound):
                stream(f"http://127.0.0.1:{port}", key)
    assert keys == [f"Bearer {IN_FILE}", f"Bearer {GIVEN}", None]


@pytest.mark.parametrize("stream", STREAMING)
def test_the_key_of_a_stream_goes_to_no_other_origin(stream: Ask) -> None:
    with hearing_streams(lambda: (HTTPStatus.NOT_FOUND, {}, "{}")) as (other, keys_there):
        away = {"Location": f"ws://127.0.0.1:{other}/lift/stream"}
        with hearing_streams(lambda: (HTTPStatus.FOUND, away, "")) as (port, keys):
            with pytest.raises(fewview.FewviewError):
                stream(f"http://127.0.0.1:{port}", GIVEN)
            assert keys == [f"Bearer {GIVEN}"]
        assert keys_there in ([], [None])


# --- what is said of it ---------------------------------------------------------------------------


@pytest.mark.parametrize("ask", [*ASKING, *STREAMING])
def test_no_log_error_or_repr_has_the_key(
    ask: Ask, caplog: pytest.LogCaptureFixture, server: Heard
) -> None:
    caplog.set_level(logging.DEBUG)
    server.status, server.body = 500, b"{}"
    for url in (url_of(server), f"http://127.0.0.1:{free_port()}"):
        with pytest.raises(fewview.FewviewError) as failed:
            ask(url, GIVEN)
        error: BaseException | None = failed.value
        while error is not None:
            assert GIVEN not in f"{error!r} {error}"
            error = error.__cause__ or error.__context__
    assert server.keys == [f"Bearer {GIVEN}"]
    assert caplog.text
    assert GIVEN not in caplog.text
    client = Client(key=GIVEN)
    parts = (client, client._driver, client._driver.http, client._driver.http.auth)
    assert not [part for part in parts if GIVEN in f"{part!r} {part}"]


@pytest.mark.parametrize("ask", ASKING)
@pytest.mark.parametrize(
    ("status", "body", "kind", "words"),
    [
        (401, "", fewview.Unauthorized, "FEWVIEW_KEY"),
        (401, '{"code": "unauthorized", "detail": "no key"}', fewview.Unauthorized, "no key Give"),
        (403, '{"code": "forbidden", "detail": "no scope"}', fewview.Forbidden, "other scopes"),
    ],
)
def test_a_refusal_says_what_to_do(
    server: Heard, ask: Ask, status: int, body: str, kind: type[fewview.ApiError], words: str
) -> None:
    server.status, server.body = status, body.encode()
    with pytest.raises(kind) as refused:
        ask(url_of(server), GIVEN)
    assert refused.value.status == status
    for expected in (words, "fewview key create", "FEWVIEW_KEY", "Client(key=...)"):
        assert expected in str(refused.value)
    assert server.keys == [f"Bearer {GIVEN}"]  # and it is not tried again


@pytest.mark.parametrize("stream", STREAMING)
def test_a_stream_that_is_refused_says_what_to_do(stream: Ask) -> None:
    problem = json.dumps({"code": "unauthorized", "detail": "no key"})
    with (
        hearing_streams(lambda: (HTTPStatus.UNAUTHORIZED, {}, problem)) as (port, _),
        pytest.raises(fewview.Unauthorized, match=r"no key .*`fewview key create`"),
    ):
        stream(f"http://127.0.0.1:{port}", GIVEN)


def test_commands_take_the_key_from_the_environment(
    server: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fewview.cli import app

    monkeypatch.setenv("FEWVIEW_KEY", IN_VARIABLE)
    server.status, server.body = 401, b""
    ran = CliRunner().invoke(app, ["models", "list", "--url", url_of(server)])
    assert ran.exit_code == 1
    assert ran.stderr.count("\n") == 1
    assert "FEWVIEW_KEY" in ran.stderr
    assert server.keys == [f"Bearer {IN_VARIABLE}"]
    monkeypatch.setenv("FEWVIEW_KEY", "two words")
    ran = CliRunner().invoke(app, ["models", "list", "--url", url_of(server)])
    assert (ran.exit_code, ran.stderr.startswith("fewview: FEWVIEW_KEY: ")) == (2, True)
    assert "two words" not in ran.stderr


def test_the_service_takes_the_token_of_its_data_folder(served: Served) -> None:
    token = (served.live.data_dir / "token").read_text().strip()
    with Client(served.live.url, token) as client:
        assert client.datasets.get(served.dataset.id) == served.dataset
        with client.stream(served.model, refine="off") as stream:
            assert stream.lift(served.capture.keypoints[0]).lifted
