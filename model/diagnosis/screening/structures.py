"""Structural candidates: a connection, a mass suspended from a body, an element at another place.

The effect of a part at a point (x, y) is a quadratic form in w = (1, x, y): its deflection is w . s and its force acts
along w . r, so that a column is sum_ij w_i w_j (r_i s_j).  The six distinct columns are computed and projected once;
every place is then scored in closed form.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, combinations_with_replacement

import numpy as np

from sprung.model.diagnosis.record.highpass import carries_everything
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.terms import Term, branches_of, supports
from sprung.model.diagnosis.rules import ScreeningRules
from sprung.model.diagnosis.screening.families import PART, STRUCTURE
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.laws import Law, StructureLaw
from sprung.model.laws.structure import AXES, elastic_modes, modal_dampers, moved_row, point_rows, sites_of
from sprung.model.mechanics import Mechanics
from sprung.model.schema import GROUND, SupportInput
from sprung.model.signals import FloatArray
from sprung.model.system import System

_PAIRS = tuple(combinations_with_replacement(range(3), 2))  # of 1, x, y
_PLACES = {"x": 9, "y": 5}  # trial places along an axis with rotation
_FAINT = 1e-3  # relative strength at which all laws are linear
_SEEN = 1e-6  # of a column's square, left by the projection


def structure_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """The best trial of every structural law at every place, with the number of trials."""
    system = projector.problem.system
    for law in laws:
        if not isinstance(law, StructureLaw):
            continue
        if law.where == "bodies":
            for one, other in unconnected(system):
                yield _connection(projector, law, one, other)
        elif law.where == "every body":
            yield from _of_all_bodies(projector, law)
        elif law.where == "body":
            for name in system.bodies:
                yield _suspended(projector, law, name)
        elif law.branches is not None:
            yield from _of_all_springs(projector, law)
        else:
            for name in system.elements:
                yield from _of_element(projector, law, name)


def _of_element(projector: Projector, law: StructureLaw, name: str) -> Iterator[tuple[Candidate, int]]:
    """Parts parallel to an element, or other positions of it."""
    system = projector.problem.system
    if law.along is None:
        for axis in law.variants:
            if turns(system, name, axis):
                yield from _moved(projector, law, name, axis)
    elif not law.holds or f"{name}.{law.holds}" not in {parameter.name for parameter in system.parameters}:
        yield _beside(projector, law, law.along, name), 1


def _of_all_springs(projector: Projector, law: StructureLaw) -> Iterator[tuple[Candidate, int]]:
    """Laws common to all springs."""
    system, grid, structure = projector.problem.system, projector.grid, projector.fit.forward.plant.structure
    springs = [name for e, name in enumerate(system.elements) if structure.stiffness[e] > 0]
    term = Term(law, "|".join(springs), (_FAINT, *law.absent[1:]))
    rates = grid.compared_spectra(projector.fit.element_motion[1].T)
    spectrum = np.zeros(projector.of_force.shape[:2], dtype=complex)
    for branch in branches_of(term, system, structure):
        force = branch.per_rate(grid.omega[grid.band]) * rates[branch.element]
        spectrum += projector.of_force[:, :, branch.element] * force[:, None]
    score, amount = projector.score(projector.pack(spectrum))
    if springs and amount > 0:
        amount, power = min(_FAINT * amount, law.parameters[0].high), projector.problem.rules.screening.power
        yield (
            Candidate(replace(term, parameters=(amount, *law.absent[1:]), scales=(amount, power)), score, STRUCTURE),
            1,
        )


def _of_all_bodies(projector: Projector, law: StructureLaw) -> Iterator[tuple[Candidate, int]]:
    """Damping ratios of all elastic modes together, where most are lightly damped."""
    system, fit, band = projector.problem.system, projector.fit, projector.grid.band
    structure = fit.forward.plant.structure
    n = system.mechanics.n
    mechanics = replace(
        system.mechanics,
        mass=structure.mass[:n],
        stiffness=structure.stiffness[: len(system.elements)],
        damping=structure.damping[: len(system.elements)],
    )
    if not _lightly_damped(mechanics, projector.problem.rules.screening):
        return
    velocity = fit.motions.velocity[band][:, :n]
    omegas, rows, below = modal_dampers(mechanics)
    columns = []
    for omega, row, under in zip(omegas, rows, below, strict=True):
        supports = (under[s] * _support_motion(projector, int(s))[1] for s in np.flatnonzero(under))
        force = -2 * omega * sum(supports, velocity @ row)
        columns.append(projector.pack((projector.of_load[:, :, :n] @ row) * force[:, None]))
    score, ratios = projector.nonnegative(np.stack(columns, axis=1))
    values = np.zeros(len(law.parameters))
    values[: len(omegas)] = np.minimum(ratios, [spec.high for spec in law.parameters[: len(omegas)]])
    fixed = tuple(index >= len(omegas) for index in range(len(values)))
    scales = (projector.problem.rules.screening.modal,) * len(values)
    term = Term(law, "|".join(system.bodies), tuple(map(float, values)), scales=scales, fixed=fixed)
    yield Candidate(term, score, STRUCTURE), 1


def _lightly_damped(mechanics: Mechanics, rules: ScreeningRules) -> bool:
    """Whether there are elastic modes, most of them damped too little to be those of bodies on dampers."""
    omegas, shapes = elastic_modes(mechanics)
    if not len(omegas):
        return False
    C = (mechanics.H.T * mechanics.damping) @ mechanics.H
    ratios = np.einsum("nm,nk,km->m", shapes, C, shapes) / (2 * omegas)
    return bool(np.median(ratios) < rules.damped_lightly)


def _beside(projector: Projector, law: StructureLaw, along: int, name: str) -> Candidate:
    """A force proportional to a derivative of an element's deflection."""
    fit, grid = projector.fit, projector.grid
    band, element = grid.band, projector.problem.system.elements.index(name)
    rate = fit.motions.rate[band, element]
    force = (fit.motions.deflection[band, element], rate, 1j * grid.omega[band] * rate)[along]
    score, amount = projector.score(projector.pack(projector.of_force[:, :, element] * force[:, None]))
    (spec,) = law.parameters
    value = float(np.clip(amount, spec.low, spec.high))
    term = Term(law, name, (value,), law.variants[0], scales=(max(abs(value), 1e-9),))
    return Candidate(term, score if value == amount else 0.0, PART)


def unconnected(system: System) -> Iterator[tuple[str, str]]:
    """Pairs of bodies, and of a body and a support or the ground, without an element between them.

    A connection parallel to an element is not distinguishable from its stiffness.
    """
    yield from combinations(system.bodies, 2)
    joined = {frozenset((element.upper, element.lower)) for element in system.file.elements.values()}
    fixed = (*supports(system), GROUND) if _knows_ground(system) else supports(system)
    for body in system.bodies:
        yield from ((body, name) for name in fixed if frozenset((body, name)) not in joined)


def _knows_ground(system: System) -> bool:
    """Whether motion relative to ground is observable, and not only relative to a single support of all bodies."""
    source = system.file.inputs[supports(system)[0]] if supports(system) else None
    accelerated = isinstance(source, SupportInput) and {*source.measured} == {"acceleration"}
    return not (accelerated and carries_everything(system, supports(system)[0]))


def turns(system: System, element: str, axis: str) -> bool:
    """Whether an element's position along an axis matters: a body at one of its ends rotates."""
    ends = system.file.elements[element]
    return any(f"{end}.{AXES[axis]}" in system.mechanics.dofs for end in (ends.upper, ends.lower))


def _places(system: System, names: tuple[str, ...]) -> tuple[FloatArray, tuple[bool, ...]]:
    """Trial places (m, 2) at bodies, and whether x and y matter."""
    of = [e.position or (0.0, 0.0) for e in system.file.elements.values() if {e.upper, e.lower} & {*names}]
    bodies = [name for name in names if name in system.file.bodies]
    of += [system.file.bodies[name].position for name in bodies]
    known = np.array(of, dtype=float)
    axes, free = [], []
    for number, (axis, rotation) in enumerate(AXES.items()):
        free.append(any(f"{name}.{rotation}" in system.mechanics.dofs for name in bodies))
        along = known[:, number]
        middle = np.linspace(along.min(), along.max(), _PLACES[axis])
        centre = [system.file.bodies[bodies[0]].position[number]]
        axes.append(np.unique(np.concatenate([along, middle]).round(6)) if free[-1] else np.array(centre))
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=-1), tuple(free)


def _forms(places: FloatArray, free: tuple[bool, ...]) -> tuple[list[tuple[int, int]], FloatArray]:
    """Pairs of (1, x, y) that matter, and their products at every place (m, pairs)."""
    w = np.column_stack([np.ones(len(places)), places])
    live = [0, *(number for number, matters in enumerate(free, 1) if matters)]
    pairs = [pair for pair in _PAIRS if pair[0] in live and pair[1] in live]
    return pairs, np.column_stack([w[:, i] * w[:, j] for i, j in pairs])


def _connection(projector: Projector, law: StructureLaw, one: str, other: str) -> tuple[Candidate, int]:
    """The best place of a spring-damper between two bodies, or between a body and a support or the ground."""
    system, fit, band = projector.problem.system, projector.fit, projector.grid.band
    location = f"{one}|{other}"
    places, free = _places(system, (one, other))
    rows, below = np.zeros((3, system.mechanics.n)), np.zeros((2, projector.of_load.shape[0]), dtype=complex)
    for sign, site in zip((1.0, -1.0), sites_of(system.file, location), strict=True):
        if site.kind == "body":
            rows += sign * point_rows(system.mechanics, site.number)
        elif site.kind == "support":
            below = _support_motion(projector, site.number)
            places = _held_at(system, one, other)
    rows = np.pad(rows, ((0, 0), (0, fit.motions.position.shape[1] - system.mechanics.n)))
    pairs, forms = _forms(places, free)
    columns = []
    for motion, under in zip((fit.motions.position, fit.motions.velocity), below, strict=True):
        along = motion[band] @ rows.T
        along[:, 0] -= under
        columns += _columns(projector, rows, along, pairs)
    score, amount = _nonnegative(projector, np.stack(columns, axis=1), forms)
    best = int(np.argmax(score))
    values = (*map(float, amount[best]), *map(float, places[best]))
    fixed = (False, False, *(not matters for matters in free))
    place = projector.problem.rules.screening.place
    term = Term(law, location, values, scales=(*_sizes(system), place, place), fixed=fixed)
    return Candidate(term, float(score[best]), STRUCTURE), len(places)


def _held_at(system: System, body: str, support: str) -> FloatArray:
    """Position of a support, (1, 2)."""
    at = [e.position for e in system.file.elements.values() if support in (e.upper, e.lower) and e.position]
    return np.array(at[:1] or [system.file.bodies[body].position], dtype=float)


def _support_motion(projector: Projector, support: int) -> ComplexArray:
    """Displacement and rate of a support over the compared bins, (2, F)."""
    forward, grid = projector.fit.forward, projector.grid
    line = forward.support_polynomial[:, support]
    swinging = forward.support[:, support]
    rate = forward.plant.derivative(line[:, None])[:, 0]
    moved = [swinging + grid.monomial_spectra @ line, 1j * grid.omega * swinging + grid.monomial_spectra @ rate]
    return np.stack(moved)[:, grid.band]


def _sizes(system: System) -> tuple[float, float]:
    """Typical stiffness and damping of a system."""
    mechanics = system.mechanics
    stiffness, damping = (values[values > 0] for values in (mechanics.stiffness, mechanics.damping))
    return _median(stiffness), _median(damping)


def _median(values: FloatArray) -> float:
    """Of what there is; 1 of nothing."""
    return float(np.median(values)) if len(values) else 1.0


def _columns(
    projector: Projector, rows: FloatArray, along: ComplexArray, pairs: list[tuple[int, int]]
) -> list[FloatArray]:
    """Responses to the parts w_i w_j of a force along rows (3, n) proportional to `along` (F, 3), each (2 F S,)."""
    push = -(projector.of_load @ rows.T)  # (F, S, 3)
    found = []
    for i, j in pairs:
        spectrum = push[:, :, i] * along[:, None, j]
        found.append(projector.pack(spectrum if i == j else spectrum + push[:, :, j] * along[:, None, i]))
    return found


def _nonnegative(projector: Projector, columns: FloatArray, forms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scores (m,) and amounts (m, 2) of stiffness and damping at every place, neither negative.

    columns (R, 2 pairs): of both, pair by pair; forms (m, pairs).
    """
    inside = projector.q.T @ columns
    whole = columns.T @ columns
    left = whole - inside.T @ inside
    product = columns.T @ projector.residual
    count = forms.shape[1]

    def of(matrix: FloatArray) -> FloatArray:
        blocks = matrix.reshape(2, count, 2, count)
        sums: FloatArray = np.einsum("mp,apbq,mq->mab", forms, blocks, forms)
        return sums

    gram, size = of(left), of(whole)
    b = np.einsum("mp,ap->ma", forms, product.reshape(2, count))
    own = np.einsum("maa->ma", gram)
    seen = own > _SEEN * np.einsum("maa->ma", size)
    own = np.where(seen, own, 1.0)
    single = np.where(seen & (b > 0), b**2 / own, 0.0)
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    good = seen.all(axis=1) & (determinant > _SEEN * own[:, 0] * own[:, 1])
    turned = np.stack(
        [gram[:, 1, 1] * b[:, 0] - gram[:, 0, 1] * b[:, 1], gram[:, 0, 0] * b[:, 1] - gram[:, 0, 1] * b[:, 0]], axis=1
    )
    both = turned / np.where(good, determinant, 1.0)[:, None]
    good &= np.all(both > 0, axis=1)
    one = np.argmax(single, axis=1)
    alone = np.where(np.arange(2) == one[:, None], np.where(single > 0, b / own, 0.0), 0.0)
    score = np.where(good, np.sum(both * b, axis=1), single.max(axis=1))
    return score, np.where(good[:, None], both, alone)


def _suspended(projector: Projector, law: StructureLaw, name: str) -> tuple[Candidate, int]:
    """The best place, frequency and damping of a suspended mass, to first order in the mass.

    Its force is m T(w) times that point's acceleration, T = (w0^2 + 2 j z w0 w) / (w0^2 - w^2 + 2 j z w0 w).
    """
    system, fit, grid = projector.problem.system, projector.fit, projector.grid
    (site,) = sites_of(system.file, name)
    places, free = _places(system, (name,))
    rows = point_rows(system.mechanics, site.number)
    rows = np.pad(rows, ((0, 0), (0, fit.motions.position.shape[1] - system.mechanics.n)))
    pairs, forms = _forms(places, free)
    along = fit.motions.acceleration[grid.band] @ rows.T
    columns = np.stack(_columns(projector, rows, along, pairs), axis=1)
    responses = projector.unpack(columns).transpose(2, 0, 1)  # (pairs, F, S)
    trials = _trials(1 / grid.step, projector.problem.rules.screening)
    transfer = _transfer(trials, grid.omega[grid.band])
    gram, product = _forms_of_trials(projector, responses, transfer)
    size = np.einsum("mp,tpq,mq->tm", forms, gram, forms, optimize=True)
    amount = product @ forms.T
    good = (size > 0) & (amount > 0)
    score = np.where(good, amount**2 / np.where(good, size, 1.0), 0.0)
    trial, place = np.unravel_index(int(np.argmax(score)), score.shape)
    body = system.mechanics.mass[system.mechanics.body_of_dof == site.number][0]
    mass = float(amount[trial, place] / size[trial, place]) if score[trial, place] > 0 else 0.01 * body
    mass = float(np.clip(mass, 1e-4 * body, body))
    values = (mass, *map(float, trials[trial]), *map(float, places[place]))
    fixed = (False, False, False, *(not matters for matters in free))
    size = projector.problem.rules.screening.place
    term = Term(law, name, values, scales=(mass, 1.0, 1.0, size, size), fixed=fixed)
    return Candidate(term, float(score[trial, place]), STRUCTURE), score.size


def _trials(sample_rate: float, rules: ScreeningRules) -> FloatArray:
    """Frequencies and damping ratios of trial masses, (trials, 2)."""
    highest, found = rules.highest_mode * sample_rate, []
    for ratio in (rules.mass_damping, 3 * rules.mass_damping):
        count = max(2, int(np.log(highest / rules.lowest_mode) / ratio))
        found += [(frequency, ratio) for frequency in np.geomspace(rules.lowest_mode, highest, count)]
    return np.array(found)


def _transfer(trials: FloatArray, omega: FloatArray) -> ComplexArray:
    """Transfer function from the point of suspension to the mass, (trials, F)."""
    w0, ratio = 2 * np.pi * trials[:, :1], trials[:, 1:]
    carried = w0**2 + 2j * ratio * w0 * omega
    return np.asarray(carried / (carried - omega**2))


def _forms_of_trials(
    projector: Projector, responses: ComplexArray, transfer: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Gram matrices (t, p, p) and products with the residual (t, p) of responses (p, F, S) times transfers (t, F).

    Columns that the projection reduces to rounding errors count as zero.
    """
    power = np.abs(transfer) ** 2
    conj = transfer.conj()
    product = np.einsum("pfs,fs->fp", responses.conj(), projector.complex_residual)
    overlap = np.einsum("pfs,qfs->fpq", responses.conj(), responses).real
    count = len(responses)
    whole = (power @ overlap.reshape(len(overlap), -1)).reshape(-1, count, count)
    basis = projector.complex_q
    inside = np.stack([(conj @ np.einsum("fs,fsq->fq", r.conj(), basis, optimize=True)).real for r in responses], 1)
    left = whole - inside @ inside.transpose(0, 2, 1)
    seen = np.einsum("tpp->tp", left) > _SEEN * np.einsum("tpp->tp", whole)
    left = np.where(seen.all(axis=1)[:, None, None], left, 0.0)
    return left, (conj @ product).real


def _moved(projector: Projector, law: StructureLaw, name: str, axis: str) -> Iterator[tuple[Candidate, int]]:
    """An element at another position along an axis: lever arm and deflection change."""
    system, fit, grid = projector.problem.system, projector.fit, projector.grid
    band, plant = grid.band, fit.forward.plant
    element = system.elements.index(name)
    change = moved_row(system.mechanics, element, axis)
    change = np.pad(change, (0, fit.motions.position.shape[1] - len(change)))
    k, c = plant.structure.stiffness[element], plant.structure.damping[element]
    force = k * fit.motions.deflection[band, element] + c * fit.motions.rate[band, element]
    more = k * (fit.motions.position[band] @ change) + c * (fit.motions.velocity[band] @ change)
    push = -(projector.of_load @ change)
    column = projector.pack(push * force[:, None] + projector.of_force[:, :, element] * more[:, None])
    score, offset = projector.score(column)
    if abs(offset) >= projector.problem.rules.setup.offset:
        term = Term(law, name, (offset,), axis, scales=(abs(offset),))
        yield Candidate(term, score, STRUCTURE), 1
