"""A law at a place with values: what is added to the nominal structure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.response.structure import Branch, Structure
from sprung.model.laws import BodyLaw, ElementLaw, Law, SensorLaw, SpringDamper, StructureLaw
from sprung.model.signals import FloatArray
from sprung.model.system import System

WIDER = "wider"  # variant of an element law: with more parameters than it has as a rule


@dataclass(frozen=True)
class Term:
    """One law at one place.  Parameters in the law's order."""

    law: Law
    location: str  # element, body, support, sensor or input channel; "left|right" of a pair or an axle
    parameters: tuple[float, ...]
    variant: str = ""  # of body laws: the mode's shape, the direction of a force
    equivalent: tuple[float, float] = (0.0, 0.0)  # stiffness and damping of the law's equivalent, kept by the plant

    scales: tuple[float, ...] = ()  # sizes at which the parameters matter, for steps and bounds; as `parameters`
    fixed: tuple[bool, ...] = ()  # parameters that the system file holds; as `parameters`, none if left out
    known: tuple[float, ...] = ()  # deviations from absence that are expected; as `parameters`, any if left out

    def at(self, parameters: FloatArray) -> Term:
        return replace(self, parameters=tuple(float(v) for v in parameters))

    @property
    def element_law(self) -> ElementLaw:
        """The law, of a term that acts along an element."""
        if not isinstance(self.law, ElementLaw):
            raise TypeError(f"{self.law.name} at {self.location} is no law of an element")
        return self.law

    def moved(self, index: int, step: float) -> Term:
        """One internal parameter moved: the logarithm of those of unknown order, else the value."""
        values = list(self.parameters)
        values[index] = values[index] * np.exp(step) if self.law.parameters[index].log else values[index] + step
        return replace(self, parameters=tuple(values))

    def advanced(self, step: FloatArray) -> Term:
        """All internal parameters moved but those that are held, values kept within the law's bounds.

        Steps are limited in their direction: a yield deflection that stays as its exponent moves takes both.
        """
        values = []
        largest = max((abs(x) for spec, x in zip(self.law.parameters, step, strict=True) if spec.log), default=0.0)
        step = step / max(1.0, largest)
        fixed = self.fixed or (False,) * len(self.parameters)
        for spec, value, change, held in zip(self.law.parameters, self.parameters, step, fixed, strict=True):
            new = value * np.exp(change) if spec.log else value + change
            values.append(value if held else float(min(max(new, spec.low), spec.high)))
        return replace(self, parameters=tuple(values))

    def held_back(self, step: FloatArray) -> list[bool]:
        """Which parameters stand at a bound that a step would take them over."""
        fixed = self.fixed or (False,) * len(self.parameters)
        entries = zip(self.law.parameters, self.parameters, step, fixed, strict=True)
        return [f or (v <= spec.low and s < 0) or (v >= spec.high and s > 0) for spec, v, s, f in entries]

    @property
    def slopes(self) -> FloatArray:
        """Derivative of each parameter with respect to its internal form."""
        pairs = zip(self.law.parameters, self.parameters, strict=True)
        return np.array([value if spec.log else 1.0 for spec, value in pairs])

    @property
    def strayed(self) -> FloatArray:
        """Distance of each parameter from absence in expected deviations; 0 where none is expected."""
        away = np.zeros(len(self.parameters))
        for i, spread in enumerate(self.known):
            away[i] = (self.parameters[i] - self.law.absent[i]) / spread
        return away

    @property
    def bounded(self) -> bool:
        """Whether a parameter has stopped at a bound."""
        pairs = zip(self.law.parameters, self.parameters, strict=True)
        return any(value <= spec.low or value >= spec.high for spec, value in pairs)

    @property
    def key(self) -> tuple[str, str, str]:
        return (self.location, self.law.name, self.variant)

    def port(self, system: System) -> FloatArray:
        """Weights over elements: the law sees port @ deflections and pulls the elements by port * force."""
        weights = np.zeros(len(system.elements))
        names = self.location.split("|")
        weights[system.elements.index(names[0])] = 1.0
        if len(names) == 2:
            weights[system.elements.index(names[1])] = -1.0
        return weights


def given_terms(system: System) -> tuple[Term, ...]:
    """The laws that the system file puts in place, but for faults of measurements, which are undone in the signals."""
    found = []
    for placed in system.laws:
        law = placed.law
        if isinstance(law, SensorLaw):
            continue
        scales = tuple(max(abs(value), 1e-12) for value in placed.values)
        variant = placed.variant
        if isinstance(law, BodyLaw) and not variant:
            variant = law.variants(system.mechanics, system.bodies.index(placed.location))[0]
        elif isinstance(law, StructureLaw) and not variant:
            variant = law.variants[0]
        elif isinstance(law, ElementLaw) and any(getattr(other, "wider", None) is law for other in system.catalogue):
            variant = WIDER
        found.append(Term(law, placed.location, placed.values, variant, scales=scales, fixed=placed.fixed))
    return tuple(found)


def supports(system: System) -> list[str]:
    """The inputs that move: moving supports, in the order of their columns."""
    return [name for name, source in system.file.inputs.items() if source.kind != "force"]


def branches_of(term: Term, system: System, structure: Structure) -> tuple[Branch, ...]:
    """The branches that a law with linear memory puts beside its elements; none: it is no such law.

    structure: of the model, with its stiffnesses and dampings.
    """
    law = term.law
    places = [system.elements.index(name) for name in term.location.split("|") if name in system.elements]
    if isinstance(law, ElementLaw) and law.branch is not None:
        return tuple(Branch(e, *law.branch(term.parameters, float(structure.damping[e]))) for e in places)
    if isinstance(law, StructureLaw) and law.branches is not None:
        of = [(e, SpringDamper(structure.stiffness[e], structure.damping[e])) for e in places]
        return tuple(Branch(e, *branch) for e, element in of for branch in law.branches(term.parameters, element))
    return ()


def is_waveform(term: Term) -> bool:
    """Whether the law's force is found along the trajectory, in the loop."""
    return isinstance(term.law, ElementLaw) and term.law.branch is None
