"""Removal of secrets from what leaves a process: errors, logs, health, answers, bug reports."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

REMOVED = "REMOVED"
_MIN_SECRET_CHARS = 5  # of what is removed from texts: shorter ones are parts of other words
_SECRET_NAMES = re.compile(r"passw|token|secret|credential|login|webhook|api_?key|(^|_)keys?$", re.IGNORECASE)
_URL_USER = re.compile(r"(://)[^/@\s\"']+@")
_URL_PARAMETER = re.compile(
    r"([?&;][^=&\s]*(?:passw|token|secret|key|auth|pwd)[^=&\s]*=)[^&\s\"']+", re.IGNORECASE
)
_ASSIGNMENT = re.compile(
    r"((?:passw(?:or)?d|token|secret|authorization|bearer)[\"']?\s*[:=]\s*(?:bearer\s+)?)[^\s,;\"']+",
    re.IGNORECASE,
)
_PRIVATE_KEY = re.compile(
    r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(-----END [A-Z ]*PRIVATE KEY-----|\Z)", re.DOTALL
)


def is_secret(option: str) -> bool:
    """Return whether an option with this name contains a secret, such as a password, token or key."""
    return _SECRET_NAMES.search(option) is not None


def without_secrets(text: str) -> str:
    """Return a copy of a text without private keys, and without user names, passwords and tokens in URLs."""
    text = _PRIVATE_KEY.sub(REMOVED, text)
    text = _URL_USER.sub(rf"\1{REMOVED}@", text)
    return _URL_PARAMETER.sub(rf"\1{REMOVED}", text)


@dataclass
class Redactor:
    """Remover of secrets from tables and texts.

    Secrets are values of options with a name such as password, token or key, wherever the value occurs, user
    names and passwords in URLs, and private keys.
    """

    _values: set[str] = field(default_factory=set)

    def table(self, value: Any, name: str = "") -> Any:
        """Return a copy of a parsed TOML value without secrets; `text` removes the same secrets later.

        `name` is the option that the value belongs to.
        """
        if isinstance(value, dict):
            return {key: self.table(item, str(key)) for key, item in value.items()}
        if is_secret(name) and value not in ("", None):
            self._values |= {str(v) for v in (value if isinstance(value, (list, tuple)) else [value])}
            return REMOVED
        if isinstance(value, (list, tuple)):
            return [self.table(item, name) for item in value]
        return self.text(value) if isinstance(value, str) else value

    def text(self, text: str) -> str:
        """Return a copy of a text in which all secrets are replaced by `REMOVED`."""
        for value in sorted(self._values, key=len, reverse=True):
            if len(value) >= _MIN_SECRET_CHARS:
                text = text.replace(value, REMOVED)
        return _ASSIGNMENT.sub(rf"\1{REMOVED}", without_secrets(text))
