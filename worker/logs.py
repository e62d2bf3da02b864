"""Lines of the log, as text or as JSON, with the request and the job that they belong to."""

import json
import logging
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from types import TracebackType
from typing import Literal

from fewview.plain import visible
from typing_extensions import TypeAliasType

LogFormat = TypeAliasType("LogFormat", Literal["text", "json"])

TEXT = "%(asctime)s %(name)s %(message)s%(context)s"
# What is taken for an identifier: visible ASCII, so that it can forge no line.
REQUEST_ID = re.compile(r"[!-~]{1,128}")

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)

logger = logging.getLogger(__name__)


class _Json(logging.Formatter):
    """Writes each record as a JSON object on a line of its own."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        moment = datetime.fromtimestamp(record.created, UTC)
        line = {
            "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        for name in ("request_id", "job_id"):
            if (value := getattr(record, name, None)) is not None:
                line[name] = value
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        if record.stack_info:
            line["stack"] = self.formatStack(record.stack_info)
        return json.dumps(line)


class _Text(logging.Formatter):
    """Writes each record as text; what names of others would do to a terminal is spelled out."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines."""
        return visible(super().format(record))


_handler = logging.StreamHandler()


def set_up(log_format: LogFormat = "text") -> None:
    """Have this process write its log on stderr in a format; called again, it changes the format.

    With `json`, warnings of libraries and errors that end a thread or the process are lines, too.
    """
    if not _handler.filters:
        _handler.addFilter(_add_context)
    _handler.setFormatter(_Json() if log_format == "json" else _Text(TEXT))
    logging.basicConfig(level=logging.INFO, handlers=[_handler])
    if log_format == "json":
        logging.captureWarnings(True)
        sys.excepthook = _log_end
        threading.excepthook = _log_end_of_thread


def say(text: str) -> None:
    """Print on stdout what people wait for, in the format of the log."""
    if isinstance(_handler.formatter, _Json):
        record = logging.makeLogRecord({"name": __name__, "levelname": "INFO", "msg": text})
        text = _handler.formatter.format(record)
    print(visible(text), flush=True)


@contextmanager
def of_job(job: str | None, request: object = None) -> Iterator[None]:
    """Have the lines that are written inside carry a job, and the request that it came from.

    Parameters
    ----------
    request
        Its identifier, as far as anybody may have written it: what is none is left out.
    """
    known = isinstance(request, str) and REQUEST_ID.fullmatch(request)
    tokens = job_id.set(job), request_id.set(str(request) if known else None)
    try:
        yield
    finally:
        job_id.reset(tokens[0])
        request_id.reset(tokens[1])


def _add_context(record: logging.LogRecord) -> bool:
    request, job = request_id.get(), job_id.get()
    known = (("request", request), ("job", job))
    found = ", ".join(f"{name} {value}" for name, value in known if value is not None)
    vars(record).update(request_id=request, job_id=job, context=f" [{found}]" if found else "")
    return True


def _log_end(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)
    else:
        logger.critical("The process ends", exc_info=(kind, error, trace))


def _log_end_of_thread(ended: threading.ExceptHookArgs) -> None:
    if ended.exc_value is not None and not issubclass(ended.exc_type, SystemExit):
        error = (ended.exc_type, ended.exc_value, ended.exc_traceback)
        logger.critical("A thread ends", exc_info=error)
