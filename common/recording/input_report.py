"""Report of what was repaired or refused in messages of sensors: one place for bags, ROS 2 and drivers.

Entries are counted by topic, field and reason. `sentences` is what `beamsplat info`, the status of a source
and the end of a run show.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from beamsplat.common.status import general_reason

MAX_ENTRIES = 48  # further ones are counted together
_CHARS = 80  # of a value
_OTHER = "other reasons"


class InputFault(ValueError):
    """A message, or a field of it, cannot be used.

    Attributes:
        field: name of the field in the message of the sensor, for example "time_increment"; "" = all of it.
        value: its value, as text.
        what: why it cannot be used, without field and value.
        remedy: what the user can do; "" = unknown.
    """

    def __init__(self, field: str, value: object, what: str, remedy: str = "") -> None:
        self.field, self.value, self.what, self.remedy = field, str(value)[:_CHARS], what, remedy
        super().__init__(_text(field, self.value, what, remedy))


@dataclass
class InputFinding:
    """One kind of repair or refusal, with the first value for which it was needed."""

    action: Literal["repaired", "refused"]
    topic: str
    field: str
    value: str
    what: str
    remedy: str
    count: int = 0  # messages

    @property
    def reason(self) -> str:
        """Return topic, field, value, what was done and the remedy, without the count."""
        return f"{self.topic}: {self.action}: {_text(self.field, self.value, self.what, self.remedy)}"

    @property
    def sentence(self) -> str:
        """Return one sentence: topic, how often, field, value, what was done, and the remedy."""
        number = f"{self.count} message{'s' * (self.count != 1)} {self.action}"
        return f"{self.topic}: {number}: {_text(self.field, self.value, self.what, self.remedy)}"


class InputReport:
    """Bounded counter of repairs and refusals, by topic, field and reason."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, ...], InputFinding] = {}
        self.last_refusal = ""  # the newest one, without its topic

    def repaired(self, topic: str, field: str, value: object, what: str, remedy: str = "") -> None:
        """Count one message that is used although `field` was wrong; `what`: the fault and the repair."""
        self._add(InputFinding("repaired", topic, field, str(value)[:_CHARS], what, remedy))

    def refused(self, topic: str, fault: ValueError) -> None:
        """Count one message that is not used, because of an `InputFault` or an error of validation."""
        self.last_refusal = reason_of(fault)
        if isinstance(fault, InputFault):
            self._add(InputFinding("refused", topic, fault.field, fault.value, fault.what, fault.remedy))
        else:
            self._add(InputFinding("refused", topic, "", "", reason_of(fault), ""))

    @property
    def findings(self) -> list[InputFinding]:
        """Return the entries: refusals first, then by topic and count."""
        return sorted(
            self._found.values(), key=lambda found: (found.action == "repaired", found.topic, -found.count)
        )

    @property
    def sentences(self) -> list[str]:
        """Return one sentence per entry."""
        return [found.sentence for found in self.findings]

    def count(self, action: Literal["repaired", "refused"], topic: str | None = None) -> int:
        """Return the number of entries' messages with this action, of one topic or of all."""
        return sum(
            found.count
            for found in self._found.values()
            if found.action == action and topic in (None, found.topic)
        )

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return the entries as dictionaries for JSON."""
        return [asdict(found) for found in self.findings]

    def clear(self) -> None:
        """Forget all entries, before the same data are read again."""
        self._found.clear()

    def _add(self, found: InputFinding) -> None:
        key = (found.action, found.topic, found.field, general_reason(found.what))
        if key not in self._found and len(self._found) >= MAX_ENTRIES:
            key = (found.action, "", "", _OTHER)
            found = InputFinding(found.action, _OTHER, "", "", _OTHER, "")
        self._found.setdefault(key, found).count += 1


def reason_of(error: Exception) -> str:
    """Return field and reason of an error of validation, in one line."""
    if hasattr(error, "errors"):
        fault = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(str(part) for part in fault['loc'])}: {fault['msg']}".removeprefix(": ")
    return str(error).split("\n")[0][:200]


def _text(field: str, value: str, what: str, remedy: str) -> str:
    name = f"{field} = {value}: " if field and value else f"{field}: " if field else ""
    return f"{name}{what}" + (f"; {remedy}" if remedy else "")
