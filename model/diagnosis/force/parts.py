"""What a component's force is made of."""

from __future__ import annotations

from sprung.model.diagnosis.force.following import Following
from sprung.model.diagnosis.force.lag import Lag
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.slider_surface import SliderSurface

LawPiece = Piece | Following | Lag  # candidates of the search
Part = LawPiece | SliderSurface
