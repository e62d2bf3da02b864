"""How the service listens and what it accepts."""

import re
from ipaddress import ip_address
from typing import Self

from pydantic import Field, field_validator, model_validator

from models.settings.keypoints import MAX_KEYPOINTS, MAX_VIEWS
from worker.cores import usable_cores
from worker.settings import WorkerSettings, listed

_ORIGIN = re.compile(r"\A(?:\*|[a-z][a-z0-9+.-]*://[^/?#\s]+)")
MEBIBYTE = 1024 * 1024
WILDCARDS = ("", "0.0.0.0", "::")  # noqa: S104 (to listen on all addresses)
# Addresses that are, or have, one of the two of `localhost`: the other.
OTHER_OF_LOCALHOST = {
    **dict.fromkeys(("127.0.0.1", "localhost", "", "0.0.0.0"), "::1"),  # noqa: S104
    **dict.fromkeys(("::1", "::"), "127.0.0.1"),
}


class Settings(WorkerSettings):
    """All settings: the store's, the queue's and the service's own."""

    host: str = Field(
        "127.0.0.1",
        description="Address to listen on; another than loopback needs a key: `fewview key "
        "create`, or FEWVIEW_ADMIN_KEY.",
    )
    admin_key: str | None = Field(
        None,
        repr=False,
        pattern=r"^[!-~]{32,200}$",
        description="The token of a key with all scopes that is not in the records, for "
        "deployments whose secrets come from the environment. Set FEWVIEW_ADMIN_KEY rather than "
        "the option, which other users of the machine can read.",
    )
    trust_local: bool = Field(
        True,
        description="Whether requests without a key are allowed to processes of this machine that "
        "run as the user of the service, or as root; to their browsers with the page's own key.",
    )
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    cors_origins: str = Field(
        "",
        description="Origins of web pages whose scripts may call the API, separated by commas: "
        "https://lab.example,http://localhost:3000; * for any. Default: none.",
    )
    allowed_hosts: str = Field(
        "",
        description="Further names under which the service is reached, separated by commas, as a "
        "proxy's clients call it; * for any. Without it: localhost, addresses of loopback, and "
        "the address listened on, or any address where that is 0.0.0.0.",
    )
    api_processes: int = Field(
        default_factory=lambda: min(4, max(1, usable_cores() // 2)),
        ge=1,
        le=64,
        description="Processes that answer requests. They share the limits below on bodies in "
        "hand, large bodies, streams, threads and warm models equally. Default: one for every two "
        "CPUs, up to 4.",
    )
    workers: int | None = Field(
        None,
        ge=0,
        le=64,
        description="Worker processes that `fewview serve` starts. Default: 1 with the embedded "
        "queue, 0 with a queue of your own (start them with `fewview worker`).",
    )
    max_body_bytes: int = Field(
        256 * MEBIBYTE, ge=1024, description="Largest request body; more is refused as it arrives."
    )
    max_json_bytes: int = Field(
        64 * MEBIBYTE,
        ge=1024,
        description="Largest JSON body. Larger captures travel as safetensors or npz.",
    )
    max_unpacked_bytes: int = Field(
        1024 * MEBIBYTE,
        ge=1024,
        description="What detectors' files of a request may unpack to, together. They may unpack "
        "to 64 times their size, or 64 MiB, and to no more than the key may still keep.",
    )
    max_pending_bytes: int | None = Field(
        None,
        ge=1024,
        description="Bytes of bodies in hand at a time: received, waiting, or being answered. A "
        "body counts as 64 KiB at least, and a quarter of the bytes is kept for bodies of that "
        "size. Beyond the limit a request is refused with 503. Default: 512 MiB, or 4/3 of the "
        "largest body for each API process, if that is more.",
    )
    large_at_a_time: int = Field(
        default_factory=lambda: min(4, usable_cores()),
        ge=1,
        le=64,
        description="Bodies of more than a MiB that are worked on at a time, which takes many "
        "times their size in memory; others wait their turn, for 10 s at most. Default: the CPUs "
        "there are, up to 4.",
    )
    max_frames: int = Field(
        100_000, ge=1, description="Most frames in one request, be it an upload or a lift."
    )
    max_dataset_frames: int = Field(
        2_000_000, ge=1, description="Most frames in one dataset, over all its uploads."
    )
    max_views: int = Field(16, ge=1, le=MAX_VIEWS, description="Most views in a capture.")
    max_keypoints: int = Field(600, ge=4, le=MAX_KEYPOINTS, description="Most keypoints in a view.")
    max_requests: int = Field(
        2048,
        ge=8,
        description="Requests in hand at a time, from head to end of the answer; one more is "
        "refused with 503.",
    )
    max_queued_fits: int = Field(
        1000, ge=1, description="Fits that may wait at a time; POST /fits answers 429 beyond that."
    )
    max_queued_lifts: int = Field(
        100, ge=1, description="Lifts that may wait at a time; POST /lifts answers 429 beyond that."
    )
    max_streams: int = Field(
        64, ge=1, description="Streams open at a time; one more is refused with 503."
    )
    max_stream_bytes: int = Field(
        256 * 1024, ge=1024, description="Longest message in a stream; a frame is one message."
    )
    stream_idle_seconds: float = Field(
        60, gt=0, description="Silence of a client after which its stream is closed."
    )
    max_event_streams: int = Field(
        256,
        ge=1,
        description="Jobs followed at a time, by events, and streams watched; one more is refused "
        "with 503.",
    )
    request_seconds: float = Field(
        20,
        gt=0,
        description="Time for the head of a request to arrive. Of its body at least a KiB a second "
        "must arrive, counted over this time. A slower client loses its connection.",
    )
    drain_seconds: float = Field(
        0,
        ge=0,
        le=3600,
        description="Time to go on answering after SIGTERM while readiness is `draining`, for a "
        "balancer to notice.",
    )
    grace_seconds: float = Field(
        10,
        ge=0,
        le=3600,
        description="Time after that for requests in hand, such as downloads, to be finished.",
    )
    lift_threads: int = Field(
        default_factory=lambda: min(8, usable_cores()),
        ge=1,
        le=64,
        description="Threads that lift. Default: the CPUs there are, up to 8.",
    )
    warm_model_bytes: int = Field(
        512 * MEBIBYTE, ge=0, description="Weights to keep in memory for lifting."
    )

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, origins: str) -> str:
        for origin in listed(origins):
            if not _ORIGIN.fullmatch(origin):
                raise ValueError(
                    "expected origins such as https://lab.example or http://localhost:3000, "
                    f"without a path and separated by commas, or *; got {origin!r}"
                )
        return origins

    @property
    def reached_at(self) -> str:
        """The host under which this machine reaches what listens, as URLs have it."""
        if self.host in WILDCARDS:
            return "[::1]" if self.host == "::" else "127.0.0.1"
        return f"[{self.host}]" if ":" in self.host else self.host

    @property
    def addresses(self) -> list[str]:
        """The addresses to listen on: where one is what `localhost` names, both that it names."""
        other = OTHER_OF_LOCALHOST.get(self.host.lower())
        return [self.host] if other is None else [self.host, other]

    @property
    def allowed_origins(self) -> list[str]:
        """The origins of web pages that may call the API, one by one."""
        return listed(self.cors_origins)

    @property
    def allowed_names(self) -> list[str]:
        """Further names under which the service is reached, one by one."""
        return listed(self.allowed_hosts)

    @property
    def resolved_pending_bytes(self) -> int:
        """Bytes of bodies in hand at a time, the default included."""
        return self.max_pending_bytes or max(512 * MEBIBYTE, self._least_pending_bytes)

    @property
    def _least_pending_bytes(self) -> int:
        """The largest body for each process, and the quarter that is kept for small ones."""
        return -(-4 * self.max_body_bytes // 3) * self.api_processes

    def share(self) -> Self:
        """Return the settings of one of the API's processes: its part of what all may take."""
        whole = {
            "max_pending_bytes": self.resolved_pending_bytes,
            "large_at_a_time": self.large_at_a_time,
            "max_requests": self.max_requests,
            "max_streams": self.max_streams,
            "max_event_streams": self.max_event_streams,
            "lift_threads": self.lift_threads,
            "warm_model_bytes": self.warm_model_bytes,
        }
        part = {name: max(1, value // self.api_processes) for name, value in whole.items()}
        return self.model_copy(update=part | {"api_processes": 1})

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if self.resolved_pending_bytes < self._least_pending_bytes:
            raise ValueError(
                "expected max_pending_bytes to be 4/3 of max_body_bytes at least for each of "
                f"{self.api_processes} API processes: {self._least_pending_bytes}, "
                f"got {self.max_pending_bytes}"
            )
        return self


def is_loopback(host: str) -> bool:
    """Return whether a host, by name or address, is loopback."""
    if host == "localhost" or host.endswith(".localhost"):
        return True
    return is_address(host) and ip_address(host).is_loopback


def is_address(host: str) -> bool:
    """Return whether a host is an address, not a name."""
    try:
        ip_address(host)
    except ValueError:
        return False
    return True
