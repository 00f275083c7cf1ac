"""Laws of the catalogue by name and kind: what can be asked of one depends on its kind."""

from __future__ import annotations

from sprung.model.laws import BodyLaw, ElementLaw, SensorLaw, SupportLaw, find_law


def element_law(name: str) -> ElementLaw:
    law = find_law(name)
    assert isinstance(law, ElementLaw)
    return law


def wider_law(name: str) -> ElementLaw:
    """The wider form of an element's law."""
    law = element_law(name).wider
    assert law is not None
    return law


def body_law(name: str) -> BodyLaw:
    law = find_law(name)
    assert isinstance(law, BodyLaw)
    return law


def support_law(name: str) -> SupportLaw:
    law = find_law(name)
    assert isinstance(law, SupportLaw)
    return law


def sensor_law(name: str) -> SensorLaw:
    law = find_law(name)
    assert isinstance(law, SensorLaw)
    return law
