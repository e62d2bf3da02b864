"""The ``fewview`` command."""

import logging
import os
import sys
from importlib.metadata import version

from pydantic import ValidationError
from pydantic_settings import CliApp, SettingsConfigDict

from service.settings import Settings
from worker.settings import WorkerSettings

ENVIRONMENT_HELP = """
Every option can also be set by an environment variable, FEWVIEW_ and its name: --redis-url is
FEWVIEW_REDIS_URL. Options win over variables."""

USAGE = """usage: fewview [--version] COMMAND [OPTION ...]

commands:
  serve    run the API; with no settings at all also a queue and a worker
  worker   run a worker that fits what is on the queue

`fewview COMMAND --help` lists a command's options.
"""


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


def main() -> None:
    """Run the command line and exit with its status: 0, or 2 with the reason on stderr."""
    command, arguments = (sys.argv[1] if len(sys.argv) > 1 else "--help"), sys.argv[2:]
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
    try:
        if command == "serve":
            serve(arguments)
        elif command == "worker":
            work(arguments)
        elif command == "--version":
            print(f"fewview {version('fewview')}")
        elif command in ("--help", "-h"):
            print(USAGE, end="")
        else:
            sys.exit(f"fewview: there is no command {command!r}\n{USAGE}")
    except ValidationError as error:
        for item in error.errors():
            option = "--" + "-".join(str(part) for part in item["loc"]).replace("_", "-")
            message = item["msg"].removeprefix("Value error, ")
            print(f"fewview {command}: {option}: {message}", file=sys.stderr)
        sys.exit(2)


def serve(arguments: list[str]) -> None:
    """Run ``fewview serve``."""
    from service.process.supervisor import StartError, serve  # noqa: PLC0415 (not needed by a worker)

    settings = CliApp.run(Serve, cli_args=arguments)
    try:
        serve(settings)
    except StartError as error:
        print(f"fewview serve: {error}", file=sys.stderr)
        sys.exit(2)


def work(arguments: list[str]) -> None:
    """Run ``fewview worker``."""
    from worker.runner import run  # noqa: PLC0415 (not needed by the supervisor)

    settings = CliApp.run(Work, cli_args=arguments)
    os.environ |= settings.to_environment()  # jobs run in processes that read them there
    try:
        run(settings)
    except ValueError as error:
        print(f"fewview worker: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
