"""What endpoints that lift ask for, as annotated dependencies."""

from typing import Annotated

from fastapi import Depends, Request

from service.realtime.engine import Engine
from service.realtime.rooms import Rooms


async def get_engine(request: Request) -> Engine:
    """Return the engine that keeps models warm."""
    engine: Engine = request.app.state.engine
    return engine


async def get_rooms(request: Request) -> Rooms:
    """Return the rooms of models."""
    rooms: Rooms = request.app.state.rooms
    return rooms


EngineDep = Annotated[Engine, Depends(get_engine)]
RoomsDep = Annotated[Rooms, Depends(get_rooms)]
