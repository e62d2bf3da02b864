"""The commands of ``fewview`` that are the server's; the others are the client's."""

import os
import sys
from argparse import ArgumentParser
from collections.abc import Callable

from pydantic import ValidationError
from pydantic_settings import CliApp, SettingsConfigDict

from service.settings import Settings
from store.errors import StoreError
from worker import logs
from worker.settings import WorkerSettings

ENVIRONMENT_HELP = """
Every option can also be set by an environment variable, FEWVIEW_ and its name: --redis-url is
FEWVIEW_REDIS_URL. Options win over variables."""

PRECOMPILE_HELP = """Compile the inner loops of fits and lifts, some minutes, before anybody waits
for it: when an image is built, for one. Later processes of this user read the machine code that it
leaves in NUMBA_CACHE_DIR."""

POSITIONAL = ("part", "folder")  # arguments that are given without their name


class Serve(Settings):  # noqa: D101
    __doc__ = f"""Run the API on http://127.0.0.1:8000.

With no settings at all, an embedded Valkey (queue), SQLite (records), a local folder (objects) and
one worker process are started with it and stopped with it.
{ENVIRONMENT_HELP}
"""

    model_config = SettingsConfigDict(cli_prog_name="fewview serve", cli_kebab_case=True)


class Work(WorkerSettings):  # noqa: D101
    __doc__ = f"""Run a worker, until SIGTERM: a running fit is then saved and given back.

Any number of workers may share a queue, on any number of hosts. All need the same records and
objects as the API.
{ENVIRONMENT_HELP}
"""

    model_config = SettingsConfigDict(cli_prog_name="fewview worker", cli_kebab_case=True)


def run(command: str, arguments: list[str]) -> None:
    """Run a command of the server; exit with status 2 and the reason on stderr if it cannot."""
    logs.set_up()
    if command != "precompile":  # whose machine code all users of an image may read
        os.umask(0o077)  # what is written is nobody else's, wherever records and objects live
    try:
        COMMANDS[command](arguments)
    except ValidationError as error:
        for item in error.errors():
            name = "-".join(str(part) for part in item["loc"]).replace("_", "-")
            dashes = "" if name in POSITIONAL else "--"
            where = f"{dashes}{name}: " if name else ""  # what is wrong with several names them
            message = item["msg"].removeprefix("Value error, ")
            print(f"fewview {command}: {where}{message}", file=sys.stderr)
        sys.exit(2)


def serve(arguments: list[str]) -> None:
    """Run ``fewview serve``."""
    from service.process.listening import StartError  # noqa: PLC0415 (not needed by a worker)
    from service.process.supervisor import serve  # noqa: PLC0415 (the same)

    settings = CliApp.run(Serve, cli_args=arguments)
    logs.set_up(settings.log_format)
    try:
        serve(settings)
    except StartError as error:
        print(f"fewview serve: {error}", file=sys.stderr)
        sys.exit(2)


def work(arguments: list[str]) -> None:
    """Run ``fewview worker``."""
    from worker.runner import run  # noqa: PLC0415 (not needed by the supervisor)

    settings = CliApp.run(Work, cli_args=arguments)
    logs.set_up(settings.log_format)
    os.environ |= settings.to_environment()  # jobs run in processes that read them there
    try:
        run(settings)
    except (ValueError, StoreError) as error:
        print(f"fewview worker: {error}", file=sys.stderr)
        sys.exit(2)


def precompile(arguments: list[str]) -> None:
    """Run ``fewview precompile``."""
    words = ArgumentParser(prog="fewview precompile", description=PRECOMPILE_HELP)
    words.parse_args(arguments)
    from models.training.precompile import compile_all  # noqa: PLC0415 (takes torch and Numba)

    compile_all()


def health(arguments: list[str]) -> None:
    """Run ``fewview health``."""
    from service import health_check  # noqa: PLC0415 (not needed by the others)

    health_check.health(arguments)


def keep(command: str) -> Callable[[list[str]], None]:
    """Return what runs one of the commands in ``service.keeping``."""

    def run_command(arguments: list[str]) -> None:
        from service import keeping  # noqa: PLC0415 (not needed by the others)

        getattr(keeping, command)(arguments)

    return run_command


def let_in(command: str) -> Callable[[list[str]], None]:
    """Return what runs one of the commands in ``service.access``."""

    def run_command(arguments: list[str]) -> None:
        from service import access  # noqa: PLC0415 (not needed by the others)

        getattr(access, command)(arguments)

    return run_command


KEEPING = ("backup", "restore", "migrate", "prune", "doctor")
COMMANDS = (
    {"serve": serve, "worker": work, "precompile": precompile, "health": health}
    | {command: keep(command) for command in KEEPING}
    | {command: let_in(command) for command in ("key", "audit")}
)

if __name__ == "__main__":  # as the parts of a service are started
    run(sys.argv[1], sys.argv[2:])
