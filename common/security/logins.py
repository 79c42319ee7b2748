"""Logins of local processes: each node authenticates to the router of its host by user name and password.

Logins are used where `security.local` names a folder. The supervisor that starts the router creates them
once:

    users         one line name:password per user, for the router
    NAME.login    one line name:password, for one node, the supervisor, or `operator` (the command line)

The files are readable by their owner only, and passwords never appear on a command line. The permissions of
each user follow from the topic table (access_control.py).
"""

from __future__ import annotations

import json
import secrets
from dataclasses import dataclass
from pathlib import Path

import zenoh

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import make_folder
from beamsplat.common.security.access_control import ADMIN_USERS, local_access_control
from beamsplat.common.security.keys import SecurityConfig, is_loopback, write_private

SUPERVISOR, OPERATOR = ADMIN_USERS
USERS = "users"


@dataclass(frozen=True)
class Login:
    """User name and password of one process."""

    user: str
    password: str

    def identify(self, config: zenoh.Config) -> None:
        """Configure a Zenoh session to authenticate with this login."""
        config.insert_json5("transport/auth/usrpwd/user", json.dumps(self.user))
        config.insert_json5("transport/auth/usrpwd/password", json.dumps(self.password))


def make_logins(folder: Path, names: tuple[str, ...]) -> None:
    """Create a login for each of `names` that has no login yet; existing logins stay unchanged.

    Raises:
        UserError: the folder cannot be written, or a file in it is invalid.
    """
    folder = make_folder(folder.expanduser())
    known = _users(folder) if (folder / USERS).exists() else {}
    for name in names:
        known.setdefault(name, secrets.token_urlsafe(24))
    try:
        if folder.stat().st_mode & 0o777 != 0o700:
            folder.chmod(0o700)
        # What is written already is not written again: existing logins are used on a full or read-only disk.
        for name, password in known.items():
            if not _has(folder / f"{name}.login", f"{name}:{password}\n"):
                write_private(folder / f"{name}.login", f"{name}:{password}\n".encode())
        lines = "".join(f"{name}:{password}\n" for name, password in known.items())
        if not _has(folder / USERS, lines):
            write_private(folder / USERS, lines.encode())
    except OSError as error:
        raise UserError(f"security.local = {folder}: cannot be written ({error.strerror})") from error


def _has(path: Path, text: str) -> bool:
    """Return whether a file has this text, and only its owner can read it."""
    try:
        return path.stat().st_mode & 0o777 == 0o600 and path.read_text() == text
    except OSError:
        return False


def login_of(security: SecurityConfig, name: str) -> Login | None:
    """Return the login of a node; None if `security.local` is not set.

    Raises:
        UserError: the login file is missing, readable by others, or invalid.
    """
    if security.local is None:
        return None
    path = security.local.expanduser() / f"{name}.login"
    if not path.is_file():
        raise UserError(
            f"{path} is missing: `beamsplat run` creates the logins of its nodes when it starts the router"
        )
    ((user, password),) = _lines(path).items()
    return Login(user, password)


def require_logins(config: zenoh.Config, security: SecurityConfig, endpoints: tuple[str, ...]) -> None:
    """Configure a router to require logins, if `security.local` is set.

    Raises:
        UserError: an endpoint is reachable from other hosts, which have no logins; or the logins are missing.
    """
    if security.local is None:
        return
    for endpoint in endpoints:
        if not is_loopback(endpoint):
            raise UserError(
                f"security.local: the router's {endpoint} can be reached from other hosts, which have no "
                "login here; remove security.local on this host"
            )
    folder = security.local.expanduser()
    config.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(folder / USERS)))
    config.insert_json5("access_control", json.dumps(local_access_control(tuple(_users(folder)))))


def _users(folder: Path) -> dict[str, str]:
    return _lines(folder / USERS)


def _lines(path: Path) -> dict[str, str]:
    try:
        mode = path.stat().st_mode & 0o777
        rows = dict(line.split(":", 1) for line in path.read_text().splitlines())
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path}: no valid logins ({reason(error)}); remove its folder to have new ones created"
        ) from error
    if mode & 0o077:
        raise UserError(f"{path} can be read by others (mode {mode:03o}): chmod 600")
    if not rows:
        raise UserError(f"{path}: empty; remove its folder to have new logins created")
    return rows
