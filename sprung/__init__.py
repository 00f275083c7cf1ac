"""Sprung: condition of a train's springs and dampers from running recordings."""

__version__ = "0.1.0"
