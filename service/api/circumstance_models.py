"""Answers on how a vehicle ran."""

from __future__ import annotations

from pydantic import BaseModel, Field


class CircumstanceAnswer(BaseModel):
    """One quantity; null if it is unknown."""

    unit: str
    value: list[float | None]


class CircumstancesAnswer(BaseModel):
    """How a vehicle ran, as columns."""

    vehicle: str
    resolution: int = Field(description="seconds a point; a minute at least")
    time: list[int] = Field(description="ms since the epoch, start of each point")
    series: dict[str, CircumstanceAnswer] = Field(description="`car.load` (beside the empty mass), `temperature`, ...")
