"""Commands of users: requests with the token, executed in threads, a few at the same time."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus

from aiohttp import web

from beamsplat.services.page.access import PageAccess
from beamsplat.services.page.responses import BUSY, TRANSFER_S, RefusedRequest, json_response

_MAX_COMMANDS = 4  # at the same time
_WRONG_TOKEN_DELAY_S = 1.0  # slows down guessing

Command = Callable[[str, str, dict[str, str]], str]  # (action, node, parameters) -> result text


class CommandRequests:
    """Handler of POST /command; call `close` at the end."""

    def __init__(self, command: Command, access: PageAccess) -> None:
        self._command, self._access = command, access
        self._running = 0
        self._executor = ThreadPoolExecutor(_MAX_COMMANDS, "page-command")
        self.rejected = 0  # commands with a wrong token

    def close(self) -> None:
        """Discard the commands that have not begun."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    async def handle(self, request: web.Request) -> web.Response:
        """Execute the command in a request of an authorized user."""
        await self._check_token(request)
        try:
            async with asyncio.timeout(TRANSFER_S):
                command = json.loads(await request.read())
            action, node = str(command["action"]), str(command.get("node", ""))
            parameters = {str(k): str(v) for k, v in command.get("parameters", {}).items()}
        except (TimeoutError, ConnectionError, web.RequestPayloadError) as error:
            raise RefusedRequest(HTTPStatus.REQUEST_TIMEOUT, "the request is not complete") from error
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise RefusedRequest(
                HTTPStatus.BAD_REQUEST, 'not a command: send {"action": ..., "node": ...}'
            ) from error
        if self._running >= _MAX_COMMANDS:
            raise RefusedRequest(*BUSY)
        self._running += 1
        try:
            loop = asyncio.get_running_loop()
            done = await loop.run_in_executor(self._executor, self._command, action, node, parameters)
        except ValueError as error:
            raise RefusedRequest(HTTPStatus.CONFLICT, str(error)) from error
        finally:
            self._running -= 1
        return json_response({"text": done})

    async def _check_token(self, request: web.Request) -> None:
        if not self._access.token:
            raise RefusedRequest(
                HTTPStatus.FORBIDDEN, "commands are disabled: the page's option `token` is empty"
            )
        if not self._access.is_token(request.headers.get("Authorization", "").removeprefix("Bearer ")):
            self.rejected += 1
            await asyncio.sleep(_WRONG_TOKEN_DELAY_S)
            raise RefusedRequest(HTTPStatus.UNAUTHORIZED, "wrong token: see the page's option `token`")
