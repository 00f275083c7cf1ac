"""What can go wrong for a user, without any HTTP or exit code: those are given at the doors."""

from __future__ import annotations


class UserError(ValueError):
    """Input that cannot be used; the message is one line: what, where, what to do."""


class Busy(RuntimeError):
    """A bounded queue is full; the caller may try again later."""


class NotFound(LookupError):
    """The store holds no such thing."""
