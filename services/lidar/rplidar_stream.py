"""Decoder of RPLIDAR measurement packets to samples with times.

The device sends no time, but measures at a constant rate: the time is computed from the sample number. A
damaged packet is counted with the number of samples that it would contain.
"""

from __future__ import annotations

import numpy as np

from beamsplat.services.lidar import rplidar_packets as rp
from beamsplat.services.lidar.driver import StartAngleGate
from beamsplat.services.lidar.framing import Framer, StreamCounters
from beamsplat.services.lidar.samples import Samples

_NODE_TOLERANCE_DEG = 2.0  # a node farther from the predicted angle is rejected
_CONFIRM_NODES = 16  # consecutive nodes needed to synchronize: a node has only three bits to check


class RplidarStream:
    """Decoder of a stream of measurement packets of one type (`kind`)."""

    def __init__(self, kind: int, sample_s: float, counters: StreamCounters) -> None:
        self.kind = kind
        self._sample_s = sample_s
        self._samples = rp.SAMPLES[kind]
        checks = {
            rp.STANDARD: (rp.has_node_header, lambda packet: True, _CONFIRM_NODES),
            rp.CAPSULED: (rp.has_capsule_header, rp.capsule_checksum_ok, 3),
            rp.DENSE: (rp.has_capsule_header, rp.capsule_checksum_ok, 3),
            rp.ULTRA: (rp.has_capsule_header, rp.capsule_checksum_ok, 3),
            rp.HQ: (rp.has_hq_header, rp.hq_checksum_ok, 2),
        }
        has_header, checksum_ok, confirm_packets = checks[kind]
        check_next_header = kind in (rp.CAPSULED, rp.ULTRA, rp.DENSE)  # their 8 bit checksum is weak
        self._framer = Framer(
            rp.PACKET_BYTES[kind], has_header, checksum_ok, counters, confirm_packets, check_next_header
        )
        self._counters = counters
        self._skipped = counters.skipped_bytes
        self._start_gate = StartAngleGate()
        self._pending_capsule: tuple[bytes, int] | None = None  # needs the start angle of the next one
        self._sample_count = 0  # samples so far, including lost ones
        self._node_deg: float | None = None
        self._node_step_deg = 0.0
        self._node_gap = 0

    @property
    def newest_s(self) -> float:
        """Return the device time (s) of the newest received sample, including unconfirmed packets."""
        return (self._sample_count + self._framer.pending * self._samples) * self._sample_s

    def feed(self, data: bytes) -> list[Samples | None]:
        """Return the samples that are complete after adding `data`; None for each damaged packet."""
        found: list[Samples | None] = []
        nodes: list[tuple[float, float, float, int]] = []
        for packet in self._framer.feed(data):
            searched = self._count_skipped_samples()
            if searched:
                found += self._decode_pending(self._start_gate.median_step_deg, None)
            self._sample_count += self._samples + searched
            if self.kind == rp.STANDARD:
                self._node(packet, nodes)
                if packet is None:
                    found.append(None)
            elif self.kind == rp.HQ:
                found.append(self._hq(packet))
            else:
                found += self._capsule(packet)
        if nodes:
            angle, range_m, quality, number = np.array(nodes).T
            found.append(Samples(angle, range_m, quality, number * self._sample_s, number))
        return found

    def _count_skipped_samples(self) -> int:
        """Return the number of samples in bytes that were skipped during synchronization."""
        skipped, self._skipped = self._counters.skipped_bytes - self._skipped, self._counters.skipped_bytes
        packets = round(skipped / rp.PACKET_BYTES[self.kind])
        self._start_gate.skip_packets(packets)
        return packets * self._samples

    def _capsule(self, packet: bytes | None) -> list[Samples | None]:
        """Decode the previous capsule, whose angles need the start angle of this one or the median speed."""
        typical = self._start_gate.median_step_deg
        if packet is None:
            self._start_gate.skip_packets()
            return [*self._decode_pending(typical, None), None]
        start_deg = rp.start_deg(packet)
        if not (start_deg < 360.0 and self._start_gate.accepts(start_deg)):
            return self._decode_pending(typical, None)
        found: list[Samples | None] = []
        if (
            self._pending_capsule is not None and typical is not None
        ):  # otherwise the number of capsules between is unknown
            found = self._decode_pending((start_deg - rp.start_deg(self._pending_capsule[0])) % 360.0, packet)
        self._pending_capsule = packet, self._sample_count
        return found

    def _decode_pending(self, span_deg: float | None, following: bytes | None) -> list[Samples | None]:
        """Return the samples of the capsule that waits for its angles; it extends over `span_deg`."""
        pending, self._pending_capsule = self._pending_capsule, None
        if pending is None or span_deg is None:
            return []
        packet, last = pending
        if self.kind == rp.ULTRA:
            measured = rp.parse_ultra(packet, following)
        else:
            measured = rp.parse_capsule(packet) if self.kind == rp.CAPSULED else rp.parse_dense(packet)
        even = span_deg / self._samples * np.arange(self._samples)
        return [self._with_sample_numbers(measured.start_deg + even - measured.offset_deg, measured, last)]

    def _hq(self, packet: bytes | None) -> Samples | None:
        if packet is None:
            return None
        measured = rp.parse_hq(packet)
        return self._with_sample_numbers(measured.offset_deg, measured, self._sample_count)

    def _node(self, packet: bytes | None, nodes: list[tuple[float, float, float, int]]) -> None:
        """Append a sample without checksum to `nodes` if its angle agrees with the motor's speed."""
        self._node_gap += 1
        if packet is None:
            return
        node = rp.parse_node(packet)
        if node.angle_deg >= 360.0:
            return
        last, gap = self._node_deg, self._node_gap
        self._node_deg, self._node_gap = node.angle_deg, 0
        if last is None:
            return
        moved = (node.angle_deg - last + 180.0) % 360.0 - 180.0
        if abs(moved - gap * self._node_step_deg) > _NODE_TOLERANCE_DEG:
            return
        self._node_step_deg += 0.02 * (moved / gap - self._node_step_deg)
        nodes.append((node.angle_deg, node.range_m, node.quality, self._sample_count))

    def _with_sample_numbers(self, angle_deg: np.ndarray, measured: rp.PacketSamples, last: int) -> Samples:
        number = last - np.arange(self._samples - 1, -1, -1, dtype=np.float64)
        return Samples(angle_deg, measured.range_m, measured.quality, number * self._sample_s, number)
