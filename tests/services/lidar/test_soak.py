"""Each lidar for a minute at full rate, in real time, with 1 % wrong bytes; `make soak`."""

import time

import numpy as np
import pytest

from beamsplat.services.lidar.config import HokuyoConfig, LidarConfig, RplidarConfig
from beamsplat.services.lidar.node import HokuyoNode, LdrobotNode, RplidarNode
from tests.services.lidar.devices import EmulatedPort, Hokuyo, Ld19, Rplidar, room_range_m
from tests.services.lidar.test_live import RunningSource

KINDS = {
    "ld19": (Ld19, LdrobotNode, LidarConfig),
    "a1 express": (Rplidar, RplidarNode, RplidarConfig),
    "c1 dense": (lambda: Rplidar(0x85, 0x41, 5000.0, 10.0), RplidarNode, RplidarConfig),
    "s2 dense": (lambda: Rplidar(0x85, 0x71, 32000.0, 10.0), RplidarNode, RplidarConfig),
    "hokuyo": (Hokuyo, HokuyoNode, HokuyoConfig),
}


@pytest.mark.soak
@pytest.mark.parametrize("kind", KINDS)
def test_a_minute_of_wrong_bytes(tmp_path, kind):
    device, node_class, config = KINDS[kind]
    path = None if kind == "hokuyo" else str(tmp_path / "lidar")
    with EmulatedPort(device(), path, corruption=0.01) as plugged:
        node = node_class(config(device=path or f"tcp/127.0.0.1:{plugged.port}"))
        with RunningSource(node) as running:
            running.wait(lambda: running.messages)
            time.sleep(60.0)
            counters = node._reader.driver.counters
            print(f"{kind}: {node.detail}")
    errors, beams = [], 0
    for _, scan in running.messages:
        angle = scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(scan.ranges_m))
        measured = np.isfinite(scan.ranges_m)
        beams += len(scan.ranges_m)
        errors.append(np.abs(scan.ranges_m[measured] - room_range_m(angle[measured])))
    errors = np.concatenate(errors)
    print(
        f"{kind}: {len(running.messages)} scans, {len(errors)} ranges of {beams}, largest error {errors.max():.4f} m"
    )
    assert errors.max() < 0.06
    assert counters.bad_packets > 100 or counters.lost_samples > 1000


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["ld19", "c1 dense"])
def test_reconnect_after_five_seconds(tmp_path, kind):
    device, node_class, config = KINDS[kind]
    path = str(tmp_path / "lidar")
    with EmulatedPort(device(), path) as plugged, RunningSource(node_class(config(device=path))) as running:
        running.wait(lambda: len(running.messages) > 5)
        plugged.unplug()
        time.sleep(5.0)
        before, back = len(running.messages), time.monotonic()
        plugged.plug()
        running.wait(lambda: len(running.messages) > before)
        delay_s = running.messages[before][0] - back
        print(f"{kind}: first scan {delay_s:.2f} s after reconnecting")
    assert delay_s < 2.0
