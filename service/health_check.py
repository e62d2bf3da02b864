"""``fewview health``: does the API, or the worker, of this machine do its work? For containers."""

import json
import socket
import sys
from datetime import UTC, datetime
from http.client import HTTPConnection, HTTPException
from typing import Literal

from pydantic import Field
from pydantic_settings import CliApp, CliPositionalArg, SettingsConfigDict
from redis.exceptions import RedisError
from rq import Worker

from service.settings import Settings
from worker import at_work
from worker.queue import connect

PATIENCE_SECONDS = 3.0
SILENCE_SECONDS = 60.0  # a worker is heard of every two seconds


class Health(Settings):
    """Check whether the API, or a worker, of this machine is working.

    Exits with 0 if so, else with 1 and one line. A worker is found on the queue by the name of this
    host, some seconds after it has started. While the queue cannot be reached, a worker counts as
    working. The settings are those of the checked process: the same variables, or options. Proxies
    are not used.
    """

    model_config = SettingsConfigDict(cli_prog_name="fewview health", cli_kebab_case=True)

    part: CliPositionalArg[Literal["api", "worker"]] = Field(description="Which of them.")


def health(arguments: list[str]) -> None:
    """Run ``fewview health``."""
    settings = CliApp.run(Health, cli_args=arguments)
    well, words = _of_api(settings) if settings.part == "api" else _of_worker(settings)
    print(words)
    sys.exit(0 if well else 1)


def _of_api(settings: Settings) -> tuple[bool, str]:
    where = f"{settings.reached_at}:{settings.port}"
    connection = HTTPConnection(where, timeout=PATIENCE_SECONDS)
    try:
        connection.request("GET", "/health/ready")
        answer = connection.getresponse()
        document = json.loads(answer.read())
    except (OSError, HTTPException, ValueError) as error:
        return False, f"The API at {where} does not answer: {error}"
    finally:
        connection.close()
    if answer.status == 200:
        return True, "The API is ready."
    return False, f"The API is not ready: {document.get('detail', answer.reason)}"


def _of_worker(settings: Settings) -> tuple[bool, str]:
    if settings.redis_url is None:
        return False, "FEWVIEW_REDIS_URL is not set: a worker needs the queue's address."
    url = str(settings.redis_url)
    try:
        with connect(url, retries=0, timeout_seconds=PATIENCE_SECONDS) as redis:
            workers = Worker.all(connection=redis)
            here = [worker for worker in workers if worker.hostname == socket.gethostname()]
            working = any(at_work.is_at_work(redis, worker.key) for worker in here)
    except RedisError as error:
        return True, f"The queue is away ({error}); a worker waits for it."
    heard = [worker.last_heartbeat for worker in here if worker.last_heartbeat is not None]
    if not heard:
        return False, "No worker of this host is on the queue."
    silence = (datetime.now(UTC) - max(heard)).total_seconds()
    if silence > SILENCE_SECONDS:
        return False, f"The worker of this host was last heard of {silence:.0f} s ago."
    if not working:
        return False, "The worker of this host runs, but does no work: see its log for the reason."
    return True, "The worker is working."
