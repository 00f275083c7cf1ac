"""Beyond one machine: messages of estimates, their folding, edges, back-fill, and Ray's part (docs/fleet.md).

Ray is imported inside functions of this package only; everything but `ray_*.py` runs without it.
"""
