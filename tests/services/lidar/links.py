"""A link to an emulated device without real time."""

import numpy as np

from tests.services.lidar.devices import corrupt_bytes, room_range_m


class DirectLink:
    byte_time_s = 0.0

    def __init__(self, device):
        self._device = device
        self._waiting = b""

    def write(self, data):
        self._waiting += self._device.answer(data)

    def read(self, timeout_s):
        data, self._waiting = self._waiting, b""
        return data

    def set_motor(self, on):
        pass

    def close(self):
        pass


def run_device(driver, device, seconds, corruption=0.0, seed=0, chunk=None):
    """Return the scans of `seconds` of the device; packets are delayed by random milliseconds."""
    rng = np.random.default_rng(seed)
    driver.start(DirectLink(device))
    begin, scans = device.seconds, []
    while device.seconds - begin < seconds:
        data = corrupt_bytes(device.packet(), rng, corruption)
        at_ns = int((1000.0 + device.seconds + rng.exponential(0.003)) * 1e9)
        size = chunk or len(data)
        for i in range(0, len(data), size):
            scans += driver.feed(data[i : i + size], at_ns)
    return scans


def range_errors_m(scans):
    """Return the differences of all measured ranges from the room's walls."""
    found = [np.zeros(0)]
    for scan in scans:
        turn = scan.revolution
        angle = turn.angle_min_rad + turn.angle_increment_rad * np.arange(len(turn.range_m))
        measured = np.isfinite(turn.range_m)
        found.append(np.abs(turn.range_m[measured] - room_range_m(angle[measured])))
    return np.concatenate(found)
