"""Sprung: condition of a train's springs and dampers from running recordings."""
