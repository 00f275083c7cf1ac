"""Identification with no measured input: from the spectra of the sensors alone."""
