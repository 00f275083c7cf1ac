"""Recordings and live buses into the pipeline."""
