"""Who asks, for routes."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from sprung.service.access.tokens import Actor
from sprung.service.api.clients import client_of
from sprung.service.api.problems import ApiProblem


async def get_actor(request: Request) -> Actor:
    """The actor that the guard identified; `local` without authentication."""
    found: Actor = request.scope.get("sprung.actor") or Actor()
    return found


ActorOf = Annotated[Actor, Depends(get_actor)]


async def get_client(request: Request, actor: ActorOf) -> str:
    """Identity for per-client limits: the token or person, or the address without authentication."""
    if actor == Actor():
        return f"address {client_of(request.client.host if request.client else '')}"
    return f"token {actor.key}"


ClientOf = Annotated[str, Depends(get_client)]


def own_vehicle(actor: Actor, vehicle: str | None) -> None:
    """403 for a vehicle of another fleet, and for work whose vehicle is unknown."""
    if not actor.sees(vehicle):
        what = "name the vehicle" if vehicle is None else f"vehicle {vehicle[:128]!r} is of another fleet"
        raise ApiProblem(403, f"{what}; the token is for those that begin with {actor.fleet!r}")
