"""Laws of the system file in component tests, and identified laws to be written to it."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.component.formula import given_piece
from sprung.model.diagnosis.component.own import own_piece
from sprung.model.diagnosis.force.deviations import spread
from sprung.model.diagnosis.force.fit import ComponentFit, ComponentModel
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.report.report import IdentifiedLaw, LawParameter
from sprung.model.laws import ElementLaw, Observed
from sprung.model.laws.gas import PRELOAD
from sprung.model.laws.placed import PlacedLaw
from sprung.model.signals import FloatArray
from sprung.model.system import System


def given_model(
    system: System, element: str, seen: Observed, notes: list[str]
) -> tuple[ComponentModel, tuple[PlacedLaw, ...]]:
    """Laws of the system file at an element: a model of those to be estimated, and those with fixed values.

    seen: sizes of the element's motion.  notes: a line is appended for every law that is not used as the file has it.
    """
    model, held = ComponentModel(), []
    for placed in system.laws:
        if placed.location != element or (placed.law.constant and not all(placed.fixed)):  # part of every model
            continue
        if all(placed.fixed) and isinstance(placed.law, ElementLaw):
            held.append(placed)
            continue
        if all(placed.fixed):
            notes.append(f"{element}: {placed.law.name} is estimated, though fixed: component tests cannot hold it")
        elif any(placed.fixed):
            notes.append(
                f"{element}: some values of {placed.law.name} are fixed in the system file, others not: component "
                "tests hold all values of a law or none; none is held"
            )
        piece, shape = _piece(placed, seen)
        if piece is None:
            notes.append(f"{element}: {placed.law.name} of the system file is ignored: component tests cannot fit it")
            continue
        model = model.plus(piece, shape)
    return model, tuple(held)


def _piece(placed: PlacedLaw, seen: Observed) -> tuple[Piece | None, tuple[float, ...]]:
    if isinstance(placed.law, ElementLaw) and placed.law.of_formula:
        formula = given_piece(placed.law, placed.values)
        return formula, () if formula is None else formula.shape_of(placed.values)
    for piece in PIECES:
        if piece.law.name == placed.law.name and len(piece.law.parameters) == len(placed.values):
            return piece, piece.shape_of(placed.values)
        if piece.acting is not None and piece.acting.name == placed.law.name:
            return piece, placed.values[1:]  # strength and time of a branch
    own = own_piece(placed.law, seen) if isinstance(placed.law, ElementLaw) and placed.law.where == "element" else None
    return own, () if own is None else own.shape_of(placed.values)


def identified_laws(
    fit: ComponentFit, element: str, count: int, full: FloatArray, names: list[str], sign: float
) -> tuple[IdentifiedLaw, ...]:
    """The first `count` laws of a fit and its preload, in the form of a system file.

    full (K, K), names (K,): covariance of the fit; sign: -1 if the measured force was inverted.  Dependences on
    measured signals cannot be expressed in a system file and are omitted.
    """
    found = [_as_placed(held, element) for held in fit.task.held]
    for index, piece in enumerate(fit.model.pieces[:count]):
        if not isinstance(piece, Piece):
            continue
        law, numbers = piece.law, [value for value, _ in fit.values(index).values()]
        sigma = np.asarray(spread(fit, index, full, names)[0])
        if piece.acting is not None and piece.acting_parameters is not None:
            law = piece.acting
            numbers = list(piece.acting_parameters(fit.strengths_of(index), fit.model.shapes[index], fit.element))
            sigma = np.zeros(len(numbers))
        parameters = tuple(
            LawParameter(spec.name, float(value), float(s) if np.isfinite(s) else 0.0, spec.unit)
            for spec, value, s in zip(law.parameters, numbers, sigma, strict=True)
        )
        texts = (law.formula, law.memory_formula) if law.of_formula else ("", "")
        found.append(IdentifiedLaw(element, law.name, parameters, formula=texts[0], memory=texts[1]))
    deviation = float(np.sqrt(max(full[0, 0], 0.0)))
    if abs(fit.preload) > deviation:
        parameter = LawParameter("force", sign * fit.preload, deviation, "N")
        found.append(IdentifiedLaw(element, PRELOAD.name, (parameter,)))
    return tuple(found)


def _as_placed(held: PlacedLaw, element: str) -> IdentifiedLaw:
    values = zip(held.law.parameters, held.values, held.std, strict=True)
    parameters = tuple(LawParameter(spec.name, value, std or 0.0, spec.unit) for spec, value, std in values)
    return IdentifiedLaw(element, held.law.name, parameters)
