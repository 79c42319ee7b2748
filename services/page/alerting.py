"""Evaluation of the alerts of all robots once a second, in a thread of its own, and where they go.

Events go to the log of the page, to the log file of the node, and to the webhook. The active alerts are
kept in a file: after a restart of the page none is sent again, and the end of one that has ended meanwhile
is sent.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from pathlib import Path
from typing import Any

from beamsplat.common.config.alerts import AlertConfig
from beamsplat.common.errors import reason
from beamsplat.common.files.persist import read_limited, write_atomically
from beamsplat.common.runtime.alerts import Alert, AlertBook, AlertEvent, AlertKey, conditions
from beamsplat.common.runtime.health import NodeRecord
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.webhook import Webhook

log = logging.getLogger(__name__)

_EVERY_S = 1.0
_MAX_FILE_BYTES = 4_000_000


class Alerting:
    """The alerts of a fleet; `start` begins the evaluation, `close` ends it."""

    def __init__(
        self, fleet: Fleet, rules: AlertConfig, own_clock_id: int = 0, file: Path | None = None
    ) -> None:
        """Restore the alerts of `file`, if it exists.

        Args:
            own_clock_id: of this host (`header.local_clock_id`).
            file: keeps the active alerts; None: they are in memory only.
        """
        self.rules = rules
        self._fleet, self._own_clock_id, self._file = fleet, own_clock_id, file
        self._lock = threading.Lock()
        self._book = AlertBook(rules)
        self._write_limit = RateLimitedLog()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="alerts", daemon=True)
        address, token = rules.webhook.get_secret_value(), rules.webhook_token.get_secret_value()
        self.webhook = Webhook(address, token) if address else None
        self._restore()

    def start(self) -> None:
        """Begin to evaluate the alerts once a second."""
        self._thread.start()

    def close(self) -> None:
        """End the evaluation; active alerts remain in the file."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        if self.webhook is not None:
            self.webhook.close()

    def alerts(self, robot: str | None = None) -> list[Alert]:
        """Return the active alerts of one robot or of all, oldest first."""
        with self._lock:
            return self._book.alerts(robot)

    def update(self, now: float, now_unix_s: float) -> None:
        """Evaluate the alerts at `now` (s, `time.monotonic`), which is `now_unix_s` (s since 1970)."""
        found: dict[AlertKey, str] = {}
        known: set[str] = set()
        for robot, state in self._fleet.states().items():

            def read(records: dict[str, NodeRecord], robot: str = robot) -> None:
                if records:
                    known.add(robot)
                found.update(conditions(robot, records, self._own_clock_id, self.rules, now))

            state.with_records(read)
        with self._lock:
            events = self._book.update(found, known, now, now_unix_s)
            active = self._book.state()
        for event in events:
            self._tell(event)
        if events:
            self._write(active)

    def _run(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self.update(time.monotonic(), time.time())

    def _tell(self, event: AlertEvent) -> None:
        key, text = event.alert.key, event.alert.text
        name = key.kind.replace("_", " ")
        line = f"alert: {name}: {text}" if event.state == "begin" else f"alert ended: {name}: {text}"
        state = self._fleet.states().get(key.robot)
        if state is not None:
            state.log_event(line)
        log.warning("%s: %s", key.robot, line)
        if self.webhook is not None:
            self.webhook.post(event.as_json())

    def _write(self, active: list[dict[str, Any]]) -> None:
        if self._file is None:
            return
        try:
            write_atomically(self._file, json.dumps(active).encode())
        except OSError as error:  # a full disk is the subject of an alert, and must not end them
            if (more := self._write_limit.due("write")) is not None:
                log.error("%s: not written (%s, %d more)", self._file, reason(error), more)

    def _restore(self) -> None:
        if self._file is None:
            return
        try:
            saved = json.loads(read_limited(self._file, _MAX_FILE_BYTES))
            self._book.restore(saved, time.monotonic(), time.time())
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            log.error("%s: not read (%s): alerts that hold are sent again", self._file, reason(error))
