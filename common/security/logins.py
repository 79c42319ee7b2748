"""Who a process is to the router of its own host: a user name and a password for each node, where
`security.local` names a folder. The supervisor that starts the router makes them, once:

    users         name:password a line, for the router
    NAME.login    one such line for one node, or for `supervisor` or `operator` (the command line)

All can be read by their owner only; none is ever on a command line. What each may do follows from the topic
table (common/access.py).
"""

from __future__ import annotations

import json
import os
import secrets
from dataclasses import dataclass
from pathlib import Path

import zenoh

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import make_folder
from beamsplat.common.security.access_control import MASTERS, local_access_control
from beamsplat.common.security.keys import SecurityConfig, is_loopback

SUPERVISOR, OPERATOR = MASTERS
USERS = "users"


@dataclass(frozen=True)
class Login:
    """What a session shows to its router."""

    user: str
    password: str

    def identify(self, config: zenoh.Config) -> None:
        """Lets a session show it."""
        config.insert_json5("transport/auth/usrpwd/user", json.dumps(self.user))
        config.insert_json5("transport/auth/usrpwd/password", json.dumps(self.password))


def make_logins(folder: Path, names: tuple[str, ...]) -> None:
    """Logins for those who have none yet.

    Raises:
        UserError: the folder cannot be written, or a file in it makes no sense.
    """
    folder = make_folder(folder.expanduser())
    known = _users(folder) if (folder / USERS).exists() else {}
    for name in names:
        known.setdefault(name, secrets.token_urlsafe(24))
    try:
        folder.chmod(0o700)
        for name, password in known.items():
            _write(folder / f"{name}.login", f"{name}:{password}\n")
        _write(folder / USERS, "".join(f"{name}:{password}\n" for name, password in known.items()))
    except OSError as error:
        raise UserError(f"security.local = {folder}: cannot be written ({error.strerror})") from error


def login_of(security: SecurityConfig, name: str) -> Login | None:
    """The login of a node; None where the host's router asks for none.

    Raises:
        UserError: it is missing, readable by others, or makes no sense.
    """
    if security.local is None:
        return None
    path = security.local.expanduser() / f"{name}.login"
    if not path.is_file():
        raise UserError(
            f"{path} is missing: `beamsplat run` makes the logins of the nodes in its file when it starts "
            "the router"
        )
    ((user, password),) = _lines(path).items()
    return Login(user, password)


def guard(config: zenoh.Config, security: SecurityConfig, endpoints: tuple[str, ...]) -> None:
    """Makes a router ask for logins, where `security.local` says so.

    Raises:
        UserError: it has doors to other hosts, which show certificates instead; or no logins were made.
    """
    if security.local is None:
        return
    for endpoint in endpoints:
        if not is_loopback(endpoint):
            raise UserError(
                f"security.local: the router's {endpoint} is a door to other hosts, which have no login "
                "here; leave security.local out on this host"
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
            f"{path}: no logins ({reason(error)}); remove its folder, and new ones are made"
        ) from error
    if mode & 0o077:
        raise UserError(f"{path} can be read by others (mode {mode:03o}): chmod 600")
    if not rows:
        raise UserError(f"{path}: empty; remove its folder, and new logins are made")
    return rows


def _write(path: Path, text: str) -> None:
    """Never readable by others, not for a moment."""
    fresh = path.with_name(f".{path.name}")
    fresh.unlink(missing_ok=True)
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)
    fresh.replace(path)
