"""Whether the router of a deployment answers: before it is started, and after."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.common.security.logins import SUPERVISOR, login_of
from beamsplat.common.zenoh.bus import open_session

_START_S = 20.0  # longest start of a router


def refuse_second_router(deployment: Deployment) -> None:
    """Check that no router runs at the endpoints of a deployment yet.

    Raises:
        UserError: one answers.
    """
    if _answers(deployment):
        raise UserError(
            f"a router already runs at {', '.join(deployment.router.listen)}: stop it, name the "
            "nodes to run beside it (beamsplat run FILE NODE...), or choose another router.listen"
        )


def wait_for_router(deployment: Deployment, runs: Callable[[], bool], last_error: Callable[[], str]) -> None:
    """Wait until the router of a deployment answers.

    Args:
        runs: returns whether its process runs.
        last_error: returns the last error in its log.

    Raises:
        UserError: its process has ended, or it does not answer within 20 s.
    """
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if _answers(deployment):
            return
        if not runs():
            raise UserError(f"the router did not start: {last_error()}")
        time.sleep(0.05)
    raise UserError(f"no router at {', '.join(deployment.router.listen)} after {_START_S:.0f} s")


def _answers(deployment: Deployment) -> bool:
    with contextlib.suppress(UserError):
        login = login_of(deployment.security, SUPERVISOR)
        open_session(deployment.router.listen, wait_s=0.0, login=login).close()
        return True
    return False
