"""Errors a user can act on: one clear sentence, exit code 2, no traceback."""


class UserError(ValueError):
    """Bad input from outside (file, field, value). The text says what is wrong and what to do."""


def reason(error: BaseException) -> str:
    """What an exception says, without the number and the file name that an OSError repeats."""
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
