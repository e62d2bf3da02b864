"""What endpoints that lift ask for, as an annotated dependency."""

from typing import Annotated

from fastapi import Depends, Request

from service.realtime.engine import Engine


async def get_engine(request: Request) -> Engine:
    """Return the engine that keeps models warm."""
    engine: Engine = request.app.state.engine
    return engine


EngineDep = Annotated[Engine, Depends(get_engine)]
