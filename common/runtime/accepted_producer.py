"""Decides which process may publish on a stream: the known one, or one that proves to be its successor."""

from __future__ import annotations

from typing import Literal

from beamsplat.common.messages.instances import ProcessId, is_proven_successor

SILENCE_S = 5.0  # a process without proof is accepted when the accepted one has been silent for so long

# same: the accepted process. successor: has taken over by proof, its sequence starts at 0. other: accepted
# without proof, because it is the first one, or the accepted one is silent. stale: an earlier process.
# refused: another process, without proof.
Verdict = Literal["same", "successor", "other", "stale", "refused"]


class AcceptedProducer:
    """The process whose messages are accepted on one stream.

    Any process that may write on a stream can send any epoch, so a higher epoch alone is no proof. Only the
    supervisor of the accepted process knows the instances of later epochs
    (`beamsplat.common.messages.instances`).

    Without proof a process is accepted only after a silence (its supervisor's folder was deleted, or another
    service publishes the topic now). If the process from before the silence is heard again, or a proven
    successor of it, it replaces the unproven one at once: silence does not take a stream away from it.
    """

    def __init__(self) -> None:
        self.current: ProcessId | None = None
        self._before_silence: ProcessId | None = None

    def judge(self, process: ProcessId, silent: bool) -> Verdict:
        """Return the verdict on a message of `process`, and accept it as the producer if that is the verdict.

        Args:
            silent: the accepted process has published nothing for `SILENCE_S`.
        """
        current, before = self.current, self._before_silence
        if current is None:
            self.current = process
            return "other"
        if process == current:
            return "same"
        if is_proven_successor(process, current):
            self.current = process
            return "successor"
        if before is not None and (process == before or is_proven_successor(process, before)):
            self.current, self._before_silence = process, None
            return "other"
        if silent:
            self.current, self._before_silence = process, before or current
            return "other"
        return "stale" if is_proven_successor(current, process) else "refused"
