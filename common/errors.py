"""Errors that a user can correct: the command line prints one sentence without a traceback, exit code 2."""

from __future__ import annotations

from beamsplat.common.redaction import without_secrets


class UserError(ValueError):
    """Invalid input from a user, file or device. The text names the fault, its place and the remedy.

    Passwords in URLs are removed from the text: it is shown on other hosts and written to logs.
    """

    def __init__(self, text: str = "") -> None:
        super().__init__(without_secrets(text))


class NothingUseful(UserError):
    """A run ended without any result of a kind that it should have: exit code 3."""


def reason(error: BaseException) -> str:
    """Return the text of an exception; for an OSError without its error number and file name."""
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
