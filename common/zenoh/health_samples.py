"""Health reports as Zenoh samples: one each on a host, all of one side together across the uplink.

On a host, each node publishes its report on health/<node>. The bridge collects those of one side and
publishes them to the other one as one sample on health/bundle: one by one, they would take several kilobytes
a second of the link.
"""

from __future__ import annotations

import zenoh

from beamsplat.common.messages import Health, HealthBundle
from beamsplat.common.messages.codec import schema_of
from beamsplat.common.messages.header import DecodeError, Header
from beamsplat.common.messages.health_codec import pack_reports, unpack_reports
from beamsplat.common.topics import HEALTH, Topic
from beamsplat.common.zenoh.streams import ENCODING, decode_sample

_MAX_NODES = 1000  # of one side, whose condition is known
BUNDLE = "bundle"  # instead of the name of a node, in the key of bundles
BUNDLE_ENCODING = ENCODING.with_schema(schema_of(HealthBundle))
HEALTH_ROW = Topic(HEALTH, Health, (), 1, "latest")  # of one node
_BUNDLE_ROW = Topic(HEALTH, HealthBundle, (), 1, "latest")


def decode_health(sample: zenoh.Sample) -> list[Health]:
    """Return the reports in a sample on health/*: that of one node, or those of a bundle.

    Raises:
        DecodeError: the sample is neither, or is a bundle with the key of a node, which may speak for itself
            only.
    """
    if not is_bundle(sample):
        health = decode_sample(sample, HEALTH_ROW).message
        assert isinstance(health, Health)  # the row's message type
        return [health]
    if str(sample.key_expr).rpartition("/")[2] != BUNDLE:
        raise DecodeError("reports of several nodes")
    bundle = decode_sample(sample, _BUNDLE_ROW).message
    assert isinstance(bundle, HealthBundle)  # the row's message type
    try:
        return unpack_reports(bundle.packed)
    except ValueError as error:
        raise DecodeError(str(error)) from error


def is_bundle(sample: zenoh.Sample) -> bool:
    """Return whether a sample on health/* has the reports of several nodes."""
    schema = str(sample.encoding).partition(";")[2]
    return schema.partition("/")[0] == HealthBundle.schema_name()


class HealthCollection:
    """The newest reports of the nodes of one side, until they are sent. Not thread-safe."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], tuple[Health, Header]] = {}  # by node and instance
        self._conditions: dict[str, tuple[str, str, str]] = {}  # by node, of its last report

    def add(self, health: Health, header: Header) -> bool:
        """Replace the report of this process of a node; return whether the condition of the node has changed.

        Its condition is its process, its state and its status: viewers should not wait for news of them.
        """
        key = (health.node, health.instance)
        self._newest.pop(key, None)  # the newest is the last one
        self._newest[key] = (health, header)
        condition, before = (health.instance, health.state, health.status), self._conditions.get(health.node)
        if len(self._conditions) >= _MAX_NODES:
            self._conditions.clear()
        self._conditions[health.node] = condition
        return condition != before

    def take(self) -> tuple[HealthBundle, Header] | None:
        """Remove and return all reports, with the header of the newest; None if there are none."""
        if not self._newest:
            return None
        header = next(reversed(self._newest.values()))[1]
        reports = [health for health, _ in self._newest.values()]
        self._newest.clear()
        return HealthBundle(stamp_ns=reports[-1].stamp_ns, packed=pack_reports(reports)), header
