"""``fewview live``: keypoints as a detector finds them become 3D in another program."""

import asyncio
import math
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fewview.commands.lift import indices
from fewview.commands.talking import Url, echo, finite, talking

if TYPE_CHECKING:
    from fewview.api.stream import Start

PATIENCE = 30.0  # seconds for a service that is away


def live(
    model: Annotated[str, typer.Argument(help="Its id, mdl_..., or an alias.")],
    *,
    to: Annotated[
        str,
        typer.Option(help="`vmc://host:39539`, `osc://host:port` or `udp+json://host:port`."),
    ],
    source: Annotated[
        str | None,
        typer.Option(
            "--from", help="`udp://host:port` to listen on; else frames are lines of stdin."
        ),
    ] = None,
    views: Annotated[
        str | None, typer.Option(help="Which views of the fit the frames show, such as `0,2`.")
    ] = None,
    refine: Annotated[
        str | None, typer.Option(help="`auto`, `full` or `off`; else as in the fit.")
    ] = None,
    frame: Annotated[
        str, typer.Option(help="`room`: of the static cameras; `canonical`: of each frame.")
    ] = "room",
    up: Annotated[
        str | None,
        typer.Option(help="Up in the room: `auto`, the default, or a vector such as `0,-1,0`."),
    ] = None,
    lag: Annotated[
        int | None,
        typer.Option(min=0, max=50, help="Smooth each frame in time, by up to so many later ones."),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            max=1e5,
            callback=finite,
            help="With --lag: frames per second of `sequence`; else each frame has its `time`.",
        ),
    ] = None,
    metres: Annotated[
        float,
        typer.Option(
            min=1e-6, max=1e6, callback=finite, help="What a unit of the model is, for VMC."
        ),
    ] = 1.0,
    hold: Annotated[
        float,
        typer.Option(min=0, max=60, callback=finite, help="Seconds that a missing keypoint stays."),
    ] = 0.5,
    fade: Annotated[
        float,
        typer.Option(min=0, max=60, callback=finite, help="Seconds that it fades after that."),
    ] = 0.5,
    metrics: Annotated[
        Path | None, typer.Option(help="A file that gets a line of JSON each second.")
    ] = None,
    url: Url = None,
) -> None:
    """Send 3D on as it comes: to VR and game engines (VMC), as OSC, or as JSON."""
    from fewview.client import AsyncClient  # noqa: PLC0415 (commands load what they need)
    from fewview.live.bridge import Bridge  # noqa: PLC0415
    from fewview.live.figures import Figures  # noqa: PLC0415
    from fewview.live.holding import Holder  # noqa: PLC0415
    from fewview.live.targets import Target, address_in, writer_for  # noqa: PLC0415

    with talking(url) as client, ExitStack() as stack:
        scheme, host, port = address_in(to, ("vmc", "osc", "udp+json"), "--to")
        listen = None if source is None else address_in(source, ("udp",), "--from")[1:]
        found = client.models.get(model)
        names = (found.skeleton or {}).get("keypoint_names") or [
            f"point{place + 1}" for place in range(found.keypoints)
        ]
        start: Start = {
            "continuity": True,
            "on_overload": "all" if listen is None else "latest",
            "frame": frame,
        }
        if views is not None:
            start["views"] = indices(views)
        if refine is not None:
            start["refine"] = refine
        if frame == "room":
            start["up"] = "auto" if up in {None, "auto"} else _vector(up)
        elif up is not None:
            raise ValueError("--up: only with --frame room")
        if lag is not None:
            start["lag"] = lag
        if fps is not None and lag is None:
            raise ValueError("--fps: only with --lag")
        writer = writer_for(scheme, names, metres)
        target = Target(host, port)
        stack.callback(target.close)
        file = None if metrics is None else stack.enter_context(metrics.open("a"))
        figures = Figures(lambda line: echo(line, err=True), file)

        async def bridge() -> None:
            async with AsyncClient(url, patience=PATIENCE) as asked:
                await Bridge(
                    client=asked,
                    model=found.id,  # an alias may be moved, to one with other keypoints
                    start=start,
                    source=listen,
                    names=names,
                    writer=writer,
                    target=target,
                    holder=Holder(found.keypoints, hold, fade),
                    figures=figures,
                    fps=fps,
                ).run()

        with suppress(KeyboardInterrupt):  # which is how it usually ends
            asyncio.run(bridge())


def _vector(text: str) -> list[float]:
    try:
        vector = [float(part) for part in text.split(",")]
        if len(vector) == 3 and any(vector) and all(map(math.isfinite, vector)):
            return vector
    except ValueError:
        pass
    raise ValueError(f"--up: expected auto or a vector such as 0,-1,0, got {text!r}")
