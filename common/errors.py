"""Errors a user can act on: one clear sentence, exit code 2, no traceback."""


class UserError(ValueError):
    """Bad input from outside (file, field, value). The text says what is wrong and what to do."""
