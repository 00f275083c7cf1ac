"""Diagnoses, each in a process of its own, requested or started by misfit; and the use of their findings."""
