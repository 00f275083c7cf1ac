"""What can go wrong for a user, without any HTTP or exit code: API and command line give those."""

from __future__ import annotations

NO_THREAD = "can't start new thread"  # what Python says when there is no memory for another stack


class UserError(ValueError):
    """Input that cannot be used; the message is one line: what, where, what to do."""


class Busy(RuntimeError):
    """A bounded queue is full; the caller may try again later."""

    def __init__(self, message: str, retry_after: int = 1) -> None:
        """retry_after: seconds."""
        super().__init__(message)
        self.retry_after = retry_after


class TooManyOfOne(Busy):
    """One client has reached its share of a common resource."""


class NoSpace(RuntimeError):
    """What was sent cannot be kept: the quota or the disk is full."""


class NotFound(LookupError):
    """The store holds no such thing."""
