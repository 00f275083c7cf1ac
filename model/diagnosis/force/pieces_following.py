"""Spring, damper and laws of a component that depend on a measured signal, such as a current or a temperature."""

from __future__ import annotations

from sprung.model.diagnosis.force.following import Following
from sprung.model.diagnosis.force.parts import LawPiece
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.laws.following import Covariate, following_law


def pieces_following(signal: Covariate) -> tuple[LawPiece, ...]:
    """Pieces for the dependence of spring, damper and laws on a signal."""

    def linear(quantity: str) -> Piece:
        return Piece(
            following_law(quantity, signal),
            signs=(0,),
            parameters=lambda a, s, e: (a[0] / max(float(getattr(e, quantity)), 1e-300),),
        )

    return (
        linear("stiffness"),
        linear("damping"),
        *(Following(piece, signal) for piece in PIECES if piece.strengthened),
    )
