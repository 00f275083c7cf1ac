"""The laws of the catalogue as pieces of a component's force: strengths, shapes, and their search ranges.

By what acts: friction, dampers, springs and stops each in a file of its own, as the laws are.
The laws themselves are defined in `model.laws`.
"""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.force.piece import InertiaPiece, Piece
from sprung.model.diagnosis.force.pieces_damping import DAMPING_PIECES
from sprung.model.diagnosis.force.pieces_friction import FRICTION_PIECES
from sprung.model.diagnosis.force.pieces_stiffness import STIFFNESS_PIECES
from sprung.model.laws import ElementLaw, grid
from sprung.model.laws.drift import TIME_VARYING_DAMPING, TIME_VARYING_STIFFNESS
from sprung.model.laws.structure import INERTER


def _drift(law: ElementLaw, quantity: str) -> Piece:
    return Piece(
        law,
        shapes=("tau",),
        grid=lambda seen: grid(seen.seconds * np.array([0.1, 0.3, 1.0])),
        limits=lambda seen: [(0.03 * seen.seconds, 3.0 * seen.seconds)],
        signs=(0,),
        parameters=lambda a, s, e: (a[0] / max(float(getattr(e, quantity)), 1e-300), s[0]),
        shape_of=lambda p: (p[1],),
        rarer=1,  # nearly every misfit along one short motion has a trend
        plausible=lambda fitted: fitted.shape[0] > fitted.rules.drift * fitted.seconds,
    )


INERTIA = InertiaPiece(INERTER, signs=(1,), parameters=lambda a, s, e: (a[0],))

PIECES: tuple[Piece, ...] = (
    *FRICTION_PIECES,
    *DAMPING_PIECES,
    *STIFFNESS_PIECES,
    _drift(TIME_VARYING_STIFFNESS, "stiffness"),
    _drift(TIME_VARYING_DAMPING, "damping"),
    INERTIA,
)
