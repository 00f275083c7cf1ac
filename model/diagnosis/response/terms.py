"""Terms: laws with a location and values, added to the nominal structure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.response.structure import Branch, Structure
from sprung.model.laws import BodyLaw, ElementLaw, Law, Observed, SensorLaw, SpringDamper, StructureLaw
from sprung.model.laws.undone import is_modelled
from sprung.model.signals import FloatArray
from sprung.model.system import System

WIDER = "wider"  # variant of an element law with further parameters


@dataclass(frozen=True)
class Term:
    """One law at one location; parameters in the law's order and units."""

    law: Law
    location: str  # element, body, support, sensor or input channel; "left|right" of a pair or an axle, or of sensors
    parameters: tuple[float, ...]
    variant: str = ""  # of body laws: shape of the mode, or direction of the force
    equivalent: tuple[float, float] = (0.0, 0.0)  # equivalent stiffness N/m and damping N s/m, part of the plant

    scales: tuple[float, ...] = ()  # typical sizes, for steps and bounds; as `parameters`
    fixed: tuple[bool, ...] = ()  # held constant by the system file; as `parameters`, or empty: none
    known: tuple[float, ...] = ()  # prior standard deviation about absence; as `parameters`, or empty: no prior

    def at(self, parameters: FloatArray) -> Term:
        return replace(self, parameters=tuple(float(v) for v in parameters))

    @property
    def element_law(self) -> ElementLaw:
        """The law of a term that acts along an element.  Errors: `TypeError` for other laws."""
        if not isinstance(self.law, ElementLaw):
            raise TypeError(f"{self.law.name} at {self.location} is not a law of an element")
        return self.law

    def moved(self, index: int, step: float) -> Term:
        """The term with one internal parameter (logarithm or value, as the law says) changed by a step."""
        values = list(self.parameters)
        values[index] = values[index] * np.exp(step) if self.law.parameters[index].log else values[index] + step
        return replace(self, parameters=tuple(values))

    def advanced(self, step: FloatArray) -> Term:
        """The term after a step (p,) of its internal parameters; held ones stay, others are kept within their bounds.

        Steps are shortened along their direction, since coupled parameters (yield deflection and exponent) must
        move together.
        """
        values = []
        largest = max((abs(x) for spec, x in zip(self.law.parameters, step, strict=True) if spec.log), default=0.0)
        step = step / max(1.0, largest)
        fixed = self.fixed or (False,) * len(self.parameters)
        for spec, value, change, held in zip(self.law.parameters, self.parameters, step, fixed, strict=True):
            new = value * np.exp(change) if spec.log else value + change
            values.append(value if held else float(min(max(new, spec.low), spec.high)))
        return replace(self, parameters=tuple(values))

    def at_active_bounds(self, step: FloatArray) -> list[bool]:
        """Which parameters (p,) are held, or at a bound that the step (p,) would cross."""
        fixed = self.fixed or (False,) * len(self.parameters)
        entries = zip(self.law.parameters, self.parameters, step, fixed, strict=True)
        return [f or (v <= spec.low and s < 0) or (v >= spec.high and s > 0) for spec, v, s, f in entries]

    @property
    def slopes(self) -> FloatArray:
        """Derivatives of the parameters by their internal form, (p,)."""
        pairs = zip(self.law.parameters, self.parameters, strict=True)
        return np.array([value if spec.log else 1.0 for spec, value in pairs])

    @property
    def prior_deviations(self) -> FloatArray:
        """Distances of the parameters from absence in prior standard deviations, (p,); 0 without a prior."""
        away = np.zeros(len(self.parameters))
        for i, spread in enumerate(self.known):
            away[i] = (self.parameters[i] - self.law.absent[i]) / spread
        return away

    @property
    def bounded(self) -> bool:
        """Whether a parameter is at one of its bounds."""
        pairs = zip(self.law.parameters, self.parameters, strict=True)
        return any(value <= spec.low or value >= spec.high for spec, value in pairs)

    @property
    def places(self) -> tuple[str, ...]:
        """The names of its location."""
        return tuple(self.location.split("|"))

    @property
    def key(self) -> tuple[str, str, str]:
        return (self.location, self.law.name, self.variant)

    def port(self, system: System) -> FloatArray:
        """Weights (E,) over elements: the law acts along port @ deflections, and on the elements with port * force."""
        weights = np.zeros(len(system.elements))
        names = self.location.split("|")
        weights[system.elements.index(names[0])] = 1.0
        if len(names) == 2:
            weights[system.elements.index(names[1])] = -1.0
        return weights


def typical_scales(law: Law, motion: Observed) -> tuple[float, ...]:
    """Typical sizes of a law's parameters along an element's motion; as `Term.scales`."""
    return tuple(max(abs(spec.typical(motion)), 1e-12) for spec in law.parameters)


def given_terms(system: System) -> tuple[Term, ...]:
    """The laws of the system file, except faults of measurements that are compensated in the signals."""
    found = []
    for placed in system.laws:
        law = placed.law
        if isinstance(law, SensorLaw) and not is_modelled(placed, system.sensors):
            continue
        scales = tuple(max(abs(value), 1e-12) for value in placed.values)
        variant = placed.variant
        if isinstance(law, BodyLaw) and not variant:
            variant = law.variants(system.mechanics, system.bodies.index(placed.location))[0]
        elif isinstance(law, StructureLaw) and not variant:
            variant = law.variants[0]
        elif isinstance(law, ElementLaw) and law in _wider_forms(system):
            variant = WIDER
        found.append(Term(law, placed.location, placed.values, variant, scales=scales, fixed=placed.fixed))
    return tuple(found)


def _wider_forms(system: System) -> list[ElementLaw]:
    return [law.wider for law in system.catalogue if law.wider is not None]


def supports(system: System) -> list[str]:
    """Names of the moving supports, in the order of their columns."""
    return [name for name, source in system.file.inputs.items() if source.kind != "force"]


def branches_of(term: Term, system: System, structure: Structure) -> tuple[Branch, ...]:
    """Maxwell branches of a law with linear memory, parallel to its elements; empty for other laws.

    structure: with the stiffness and damping of the elements.
    """
    law = term.law
    places = [system.elements.index(name) for name in term.location.split("|") if name in system.elements]
    if law.branch is not None:
        return tuple(Branch(e, *law.branch(term.parameters, float(structure.damping[e]))) for e in places)
    if law.branches is not None:
        of = [(e, SpringDamper(structure.stiffness[e], structure.damping[e])) for e in places]
        return tuple(Branch(e, *branch) for e, element in of for branch in law.branches(term.parameters, element))
    return ()


def evaluated_in_time(term: Term) -> bool:
    """Whether the law's force is evaluated in time along the trajectory, by harmonic balance."""
    return term.law.in_time
