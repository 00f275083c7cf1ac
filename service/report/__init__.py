"""Mismatch reports for people: one offline HTML page and its pictures as PNG (`writing`)."""
