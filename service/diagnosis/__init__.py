"""Diagnoses, each in a process of its own, asked for or started by misfit; and what is made of their findings."""
