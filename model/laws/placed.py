"""Laws that a system file puts in place: `laws:` at elements, bodies, inputs and sensors, checked and with values."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from sprung.model.address import LawSetting, LawValue
from sprung.model.laws import CATALOGUE
from sprung.model.laws.base import ElementLaw
from sprung.model.laws.expression import FormulaError
from sprung.model.laws.formula import EFFECT, formula_law, without_force
from sprung.model.laws.kinds import BodyLaw, Law, SensorLaw, StructureLaw, SupportLaw
from sprung.model.laws.motion import SpringDamper
from sprung.model.schema import GROUND, Element, SupportInput, SystemFile

_BESIDE = ("with", "variant", "formula", "memory")  # keys of a law that are no parameters


@dataclass(frozen=True, slots=True)
class PlacedLaw:
    """A law at a place with its values."""

    law: Law
    location: str  # element, body, input, channel or sensor; "left|right" of a pair or an axle
    values: tuple[float, ...]  # in the law's order, SI
    std: tuple[float | None, ...]  # as known when it was written, or None
    fixed: tuple[bool, ...]  # not to be estimated
    variant: str = ""  # of body laws: the mode's shape, the direction of a force

    @property
    def places(self) -> tuple[str, ...]:
        """The names of the location."""
        return tuple(self.location.split("|"))

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the parameters: `secondary_2r.coulomb_friction.force`."""
        return tuple(f"{self.location}.{self.law.name}.{name}" for name in self.law.names)


def placed_laws(file: SystemFile, catalogue: Sequence[Law] = CATALOGUE) -> tuple[tuple[PlacedLaw, ...], list[str]]:
    """The laws of a system file in its order, and errors, each as `key: error`."""
    found: list[PlacedLaw] = []
    problems: list[str] = []
    for key, location, settings, kinds in _places(file):
        for index, (effect, setting) in enumerate(settings):
            try:
                found.append(_placed(file, effect, setting, location, kinds, catalogue))
            except ValueError as error:
                problems.append(f"{key}.laws.{index}.{effect}: {error}")
    return tuple(found), problems


_Settings = list[tuple[str, LawSetting]]


def _places(file: SystemFile) -> Iterator[tuple[str, str, _Settings, tuple[type, ...]]]:
    for name, element in file.elements.items():
        yield f"elements.{name}", name, _listed(element.laws), (ElementLaw, StructureLaw)
    for name, body in file.bodies.items():
        yield f"bodies.{name}", name, _listed(body.laws), (BodyLaw, StructureLaw)
    for name, source in file.inputs.items():
        yield f"inputs.{name}", name, _listed(source.laws), (SupportLaw, SensorLaw)
        if isinstance(source, SupportInput):
            for quantity, address in source.measured.items():
                yield f"inputs.{name}.{quantity}", f"{name}.{quantity}", _listed(address.laws), (SensorLaw,)
    for name, sensor in file.sensors.items():
        yield f"sensors.{name}", name, _listed(sensor.laws), (SensorLaw,)


def _listed(laws: Sequence[Mapping[str, LawSetting]]) -> _Settings:
    return [(effect, setting) for entry in laws for effect, setting in entry.items()]


def _placed(
    file: SystemFile,
    effect: str,
    setting: LawSetting,
    location: str,
    kinds: tuple[type, ...],
    catalogue: Sequence[Law],
) -> PlacedLaw:
    """One law of a file.  Errors: ValueError, one line, for anything that does not fit it."""
    numbers, texts = _numbers_and_texts(setting)
    law = _law_of(effect, texts, tuple(numbers), kinds, catalogue)
    law = _with_variant(law, texts.get("variant"))
    law = _as_wide_as(law, numbers)
    values = _values(law, numbers)
    if isinstance(law, ElementLaw) and law.of_formula:
        _check_force(law, tuple(value.value for value in values), file.elements[location])
    return PlacedLaw(
        law,
        _location(file, law, location, texts.get("with")),
        tuple(value.value for value in values),
        tuple(value.std for value in values),
        tuple(value.fixed for value in values),
        texts.get("variant", ""),
    )


def _numbers_and_texts(setting: LawSetting) -> tuple[dict[str, LawValue], dict[str, str]]:
    """Parameters, and what stands beside them."""
    texts = {name: value for name, value in setting.items() if isinstance(value, str)}
    for name, text in texts.items():
        if name not in _BESIDE:
            raise ValueError(f"{name}: a number is expected, not {text!r}")
    numbers = {name: value for name, value in setting.items() if not isinstance(value, str)}
    return {
        name: value if isinstance(value, LawValue) else LawValue(value=float(value)) for name, value in numbers.items()
    }, texts


def _law_of(
    effect: str, texts: Mapping[str, str], names: tuple[str, ...], kinds: tuple[type, ...], catalogue: Sequence[Law]
) -> Law:
    """The law of a name among those that belong to a place of these kinds; names: of the parameters that are given."""
    of_element = ElementLaw in kinds
    if effect == EFFECT and of_element:
        return _formula_of(texts, names)
    fitting = [
        law
        for law in catalogue
        if isinstance(law, kinds) and not (isinstance(law, StructureLaw) and not _belongs(law, of_element=of_element))
    ]
    for law in fitting:
        if law.name == effect:
            return law
    if any(law.name == effect for law in catalogue):
        raise ValueError("this law does not belong here")
    known = [law.name for law in fitting]
    raise ValueError(f"no such law; known here are {', '.join(known)}{did_you_mean(effect, known)}")


def _belongs(law: StructureLaw, *, of_element: bool) -> bool:
    """Whether a structural law may stand at an element, or at a body; those of all springs stand nowhere."""
    return law.where == "element" if of_element else law.where in ("body", "bodies", "every body")


def _formula_of(texts: Mapping[str, str], names: tuple[str, ...]) -> ElementLaw:
    if "formula" not in texts:
        raise ValueError("formula: the text of the force is missing")
    try:
        return formula_law(texts["formula"], texts.get("memory", ""), names)
    except FormulaError as error:
        raise ValueError(str(error)) from None


def _with_variant(law: Law, variant: str | None) -> Law:
    """The form of a law that a variant names; the law itself where its variants are choices within it."""
    if variant is None:
        return law
    if isinstance(law, (SensorLaw, ElementLaw)):
        return _form(law, variant)
    if isinstance(law, StructureLaw) and variant not in law.variants:
        raise ValueError(f"variant: {law.name} has no {variant!r}; it has {', '.join(law.variants)}")
    return law


def _form(law: SensorLaw | ElementLaw, variant: str) -> SensorLaw | ElementLaw:
    forms = dict(law.forms)
    if variant not in forms:
        known = f"it has {', '.join(forms)}" if forms else "it has none"
        raise ValueError(f"variant: {law.name} has no {variant!r}; {known}")
    return forms[variant]


def _as_wide_as(law: Law, numbers: Mapping[str, LawValue]) -> Law:
    """The wider form of a law where all of its parameters are given, else the law."""
    wider = law.wider
    return wider if wider is not None and set(numbers) == set(wider.names) else law


def _values(law: Law, numbers: Mapping[str, LawValue]) -> list[LawValue]:
    """The values of all parameters, in the law's order."""
    for name in sorted(set(numbers) - set(law.names)):
        raise ValueError(
            f"{name} is no parameter of it; it has {', '.join(law.names) or 'none'}{did_you_mean(name, law.names)}"
        )
    if law.everywhere:  # what is not named is absent
        absent = zip(law.names, law.absent, strict=True)
        numbers = {name: LawValue(value=value, fixed=True) for name, value in absent} | {**numbers}
    for name in law.names:
        if name not in numbers:
            raise ValueError(f"{name} is missing")
    for spec in law.parameters:
        if not spec.admits(numbers[spec.name].value):
            raise ValueError(
                f"{spec.name} must lie between {spec.low:g} and {spec.high:g} {spec.unit}, "
                f"not {numbers[spec.name].value:g}"
            )
    return [numbers[name] for name in law.names]


def _check_force(law: ElementLaw, values: tuple[float, ...], element: Element) -> None:
    """Formulas need to have a force at the motions of their element."""
    missing = without_force(law, values, SpringDamper(element.stiffness.value, element.damping.value))
    if missing:
        raise ValueError(f"formula {law.formula!r}: {missing}")


def _location(file: SystemFile, law: Law, location: str, partner: str | None) -> str:
    """The place with its partner, for laws that act between two; all bodies of one that acts at all."""
    if isinstance(law, StructureLaw) and law.where == "every body" and partner is None:
        return "|".join(file.bodies)
    where = law.where
    if where not in ("pair", "axle", "bodies"):
        if partner is not None:
            raise ValueError("with: this law acts at one place")
        return location
    ends = {*file.bodies, *_supports(file), GROUND}
    known = {"pair": {*file.elements}, "axle": {*file.inputs}, "bodies": ends}[where]
    if partner not in known or partner == location:
        raise ValueError(f"with: the name of the other one is expected, not {partner!r}")
    return f"{location}|{partner}"


def _supports(file: SystemFile) -> list[str]:
    return [name for name, source in file.inputs.items() if isinstance(source, SupportInput)]


def revalued(laws: Sequence[PlacedLaw], values: Mapping[str, float]) -> tuple[tuple[PlacedLaw, ...], dict[str, float]]:
    """Laws with other values by full name (`secondary_2r.coulomb_friction.force`), and what names none of theirs.

    Errors: ValueError, one line, for a value that a law does not admit.
    """
    known = {name for law in laws for name in law.names}
    for law in laws:
        for name, spec in zip(law.names, law.law.parameters, strict=True):
            if name in values and not spec.admits(values[name]):
                raise ValueError(f"{name}: must lie between {spec.low:g} and {spec.high:g} {spec.unit}")
    changed = tuple(
        replace(law, values=tuple(values.get(name, own) for name, own in zip(law.names, law.values, strict=True)))
        for law in laws
    )
    return changed, {name: value for name, value in values.items() if name not in known}


def did_you_mean(name: str, known: Sequence[str]) -> str:
    """The known name next to a wrong one, as the end of a message; empty where none is near."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
