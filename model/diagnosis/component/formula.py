"""Formula search for an unexplained force of a component: shapes of the grammar, single and in pairs.

Same grammar as for vehicles (`model.laws.grammar`).  Along the measured motion every shape is a column with an
amplitude; its own length, rate or time is searched.  Deflections are relative to the middle of the travel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.force.deviations import covariance, spread
from sprung.model.diagnosis.force.fit import ComponentModel, ComponentTask, refined
from sprung.model.diagnosis.force.piece import HYSTERESIS, STATIC, Piece, Shape
from sprung.model.diagnosis.force.ranking import Ranked, Step, next_laws
from sprung.model.diagnosis.force.search import Search
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.diagnosis.rules import ComponentRules
from sprung.model.diagnosis.selection.evidence import chance
from sprung.model.laws import UNIT_ELEMENT, ElementLaw, Motion, Observed, SpringDamper
from sprung.model.laws.formula import EFFECT
from sprung.model.laws.grammar import Shape as Form
from sprung.model.laws.grammar import forms, formula_cost, law_of
from sprung.model.signals import FloatArray

_AMPLITUDES = ("a", "b")  # as the grammar names them
# m and m/s, at which a formula is tested for being linear in its amplitudes: of the sizes of small and large motions.
_DEFLECTIONS = np.outer([1e-4, 1e-3, 1e-2], [-1.0, -0.37, 0.0, 0.45, 1.1]).ravel()
_RATES = np.outer([1e-3, 1e-2, 1e-1], [-0.9, -0.31, 0.0, 0.53, 1.3]).ravel()


@dataclass(frozen=True)
class FormulaPiece(Piece):
    """A formula as a piece of a component's force."""

    parts: int = 0  # complexity

    @property
    def commoner(self) -> int:
        """Formulas compete with each other alone, by their `parts`."""
        return 0

    @property
    def key(self) -> str:
        """Distinguishes formulas."""
        return f"{EFFECT} {self.law.formula} {self.law.memory_formula}"


def formula_piece(law: ElementLaw, grid: FloatArray | None = None, parts: int = 0) -> FormulaPiece:
    """A formula whose parameters a, b are amplitudes; grid: trial values of the others, (trials, values)."""
    amplitudes = [i for i, spec in enumerate(law.parameters) if spec.name in _AMPLITUDES]
    others = [i for i in range(len(law.parameters)) if i not in amplitudes]

    def parameters(strengths: FloatArray, shape: Shape, element: SpringDamper) -> tuple[float, ...]:
        values = dict(zip(amplitudes, map(float, strengths), strict=True)) | dict(zip(others, shape, strict=True))
        return tuple(values[i] for i in range(len(law.parameters)))

    def limits(seen: MotionSizes) -> list[tuple[float, float]]:
        sizes = {"m": seen.travel, "m/s": seen.rate_rms}
        return [
            (sizes[unit] / seen.reach, sizes[unit] * seen.reach) if unit in sizes else (seen.step, seen.seconds)
            for unit in (law.parameters[i].unit for i in others)
        ]

    return FormulaPiece(
        law=law,
        shapes=tuple(law.parameters[i].name for i in others),
        grid=lambda seen: np.zeros((1, 0)) if grid is None else grid,
        limits=limits,
        signs=(0,) * len(amplitudes),
        parameters=parameters,
        shape_of=lambda values: tuple(values[i] for i in others),
        kind=HYSTERESIS if law.memory else STATIC,
        parts=parts,
    )


def given_piece(law: ElementLaw, values: Sequence[float]) -> FormulaPiece | None:
    """A formula of a system file; None: one with a state, or not linear in amplitudes a, b."""
    piece = formula_piece(law)
    if not piece.signs or law.memory:
        return None
    amplitudes = np.array([values[i] for i, spec in enumerate(law.parameters) if spec.name in _AMPLITUDES])
    return piece if _is_linear(law, piece, amplitudes, piece.shape_of(values)) else None


def _is_linear(law: ElementLaw, piece: FormulaPiece, amplitudes: FloatArray, shape: Shape) -> bool:
    """Whether a force is a sum of amplitudes (n,) times shapes; max(a * d, b * v) scales with both and is none.

    shape: the other parameters.
    """
    d, v = np.meshgrid(_DEFLECTIONS, _RATES)

    def force(strengths: FloatArray) -> FloatArray:
        found = law.force(Motion(d, v, 0.0, ()), piece.parameters(strengths, shape, UNIT_ELEMENT), UNIT_ELEMENT)
        return np.asarray(found, dtype=float)

    with np.errstate(all="ignore"):  # what has no force at some motion is compared at the others
        columns = np.array([force(unit) for unit in np.eye(len(amplitudes))])
        defined = np.isfinite(columns).all(axis=0)
        trials = [amplitudes, -amplitudes, *(amplitudes * (1 + 2 * np.eye(len(amplitudes))))]
        return bool(defined.any()) and all(
            np.allclose(force(trial)[defined], np.tensordot(trial, columns, 1)[defined], rtol=1e-9, atol=1e-12)
            for trial in trials
        )


def formula_search(task: ComponentTask, given: ComponentModel) -> Search | None:
    """A formula beside spring, damper and the given laws; None if none is significant.

    Pairs are made of the best single shapes.
    """
    rules = task.rules
    quick, fine = task.thinned(rules.search), task.thinned(rules.fit)
    base, seen = refined(quick, given), _observed(task)
    single = {piece.key: (form, piece) for form in forms() for piece in [_single(form, seen)]}
    alone = [
        one
        for one in next_laws(base, tuple(piece for _, piece in single.values()), rules)
        if _is_determined(one, rules)
    ]
    alone.sort(key=_net_evidence, reverse=True)
    pairs = [
        _pair(single[one.last.key][0], one.fit.model.shapes[-1], form, piece, task.seen)
        for one in alone[: rules.formula_partners]
        for key, (form, piece) in single.items()
        if key != one.last.key and not (form.memory and single[one.last.key][0].memory)
    ]
    if not alone or _net_evidence(alone[0]) <= 0:
        return None
    enough = rules.formula_pair * alone[0].fit.held_out
    together = [
        one for one in next_laws(base, tuple(pairs), rules) if _is_determined(one, rules) and one.fit.held_out < enough
    ]
    chosen, before = max([alone[0], *together], key=_net_evidence), Ranked(base, 0.0, 0.0, 0.0)
    freedom = chosen.fit.model.count - base.model.count
    p_value = chance(chosen.gain, freedom, len(single))
    if p_value > rules.alpha or chosen.fit.held_out >= base.held_out:
        return None
    step = Step(chosen, before, (), p_value)
    return Search(
        refined(fine, base.model), refined(fine, chosen.fit.model), (step,), {EFFECT: chosen.gain}, tests=len(single)
    )


def _net_evidence(one: Ranked) -> float:
    """Evidence less the cost of the formula's complexity."""
    piece = one.last
    return one.evidence - formula_cost(piece.parts if isinstance(piece, FormulaPiece) else 0)


def _single(form: Form, seen: Observed) -> FormulaPiece:
    law = law_of((form,))
    return formula_piece(law, law.shapes(seen)[:, 1:], form.parts)


def _pair(one: Form, shape: Shape, other: Form, piece: FormulaPiece, seen: MotionSizes) -> FormulaPiece:
    """A pair of a shape at its best values and another with all its trial values."""
    trials = piece.grid(seen)
    rows = np.column_stack([np.tile(np.array(shape, dtype=float), (len(trials), 1)), trials])
    return formula_piece(law_of((one, other)), rows, one.parts + other.parts)


def _is_determined(one: Ranked, rules: ComponentRules) -> bool:
    """Whether every amplitude is significant."""
    index = len(one.fit.model.pieces) - 1
    sigma, _ = spread(one.fit, index, *covariance(one.fit))
    named = zip(one.fit.values(index).items(), sigma, strict=True)
    return all(abs(value) > rules.formula_significant * s for (name, (value, _)), s in named if name in _AMPLITUDES)


def _observed(task: ComponentTask) -> Observed:
    d, v = task.motion.deflection - task.motion.middle, task.motion.rate
    shares = np.linspace(0, 1, 101)
    return Observed(
        deflection=np.quantile(np.abs(d), shares),
        rate=np.quantile(np.abs(v), shares),
        deflection_rms=float(np.std(d)),
        rate_rms=float(np.std(v)),
        stiffness=1.0,
        damping=1.0,
        seconds=len(d) * task.motion.step,
    )
