"""Errors that a user can correct: the command line prints one sentence without a traceback, exit code 2."""


class UserError(ValueError):
    """Invalid input from a user, file or device. The text names the fault, its place and the remedy."""


def reason(error: BaseException) -> str:
    """Return the text of an exception; for an OSError without its error number and file name."""
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
