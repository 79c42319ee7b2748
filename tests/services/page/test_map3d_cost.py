"""CPU cost of ten viewers of a 3D map that grows: chunks are encoded once and sent ten times."""

import json
import re
import threading
import time
import urllib.error
import urllib.request

import psutil
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll
from tests.services.mapping.room_drive import TABLE

SECONDS = 12.0


class ViewerClient(threading.Thread):
    """Acts as a browser with the 3D view: after each event it fetches the index and the chunks that are new."""

    def __init__(self, address):
        super().__init__(daemon=True)
        self.bytes, self.chunks, self._address, self._on = 0, 0, address, True
        self.start()

    def _get(self, path):
        with urllib.request.urlopen(self._address + path, timeout=20) as reply:
            return reply.read()

    def run(self):
        known = {}
        with urllib.request.urlopen(self._address + "events?scan=1", timeout=20) as events:
            self._get("map3d")
            for line in events:
                if not self._on:
                    return
                if line.strip() != b"event: map3d":
                    continue
                index = json.loads(self._get("map3d"))
                for chunk in index["chunks"]:
                    if known.get(chunk["anchor"]) == chunk["revision"]:
                        continue
                    address = f"map3d/chunk/{chunk['anchor']}?producer={index['producer']}"
                    finest = chunk["levels"][0]["cell_m"]
                    try:
                        packed = self._get(f"{address}&revision={chunk['revision']}&cell_m={finest}")
                    except urllib.error.HTTPError:
                        continue  # replaced meanwhile: the next index has the new revision
                    known[chunk["anchor"]] = chunk["revision"]
                    self.bytes += len(packed)
                    self.chunks += 1


def _cpu_percent(process, supervisor):
    """Return the CPU load of a process in percent of a core, over some seconds."""
    began, before = time.monotonic(), process.cpu_times()
    while time.monotonic() < began + SECONDS:
        supervisor.poll()
        time.sleep(0.2)
    after = process.cpu_times()
    return 100.0 * (after.user + after.system - before.user - before.system) / (time.monotonic() - began)


@pytest.mark.slow
def test_nine_more_viewers_of_the_map_cost_little_cpu(tmp_path, free_endpoint, monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    nodes = {
        "replay": {"kind": "room", "pictures": 280}, "localization": {"kind": "known"}, "fusion": {"kind": "true"},
        "keyframes": {"distance_m": 0.15}, "mapping": {"half_steps": 2, "full_steps": 1, "tick_steps": 1},
        "page": {"port": 0},
    }  # fmt: skip
    deployment = Deployment(
        robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=nodes
    )
    table = {**TABLE, "page": NODES["page"]}
    with Supervisor(deployment, table=table) as supervisor, open_session((free_endpoint,)) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: "keyframes" in getattr(_health(board, "mapping"), "detail", ""), 90)
        address = re.search(r"http://\S+?/", _health(board, "page").detail)[0]
        process = psutil.Process(supervisor.children["page"].process.pid)
        none = _cpu_percent(process, supervisor)
        viewers = [ViewerClient(address)]
        poll(supervisor, lambda: viewers[0].chunks > 0, 20)
        one = _cpu_percent(process, supervisor)
        seen = viewers[0].bytes
        viewers += [ViewerClient(address) for _ in range(9)]
        poll(supervisor, lambda: all(viewer.chunks > 0 for viewer in viewers), 20)
        ten = _cpu_percent(process, supervisor)
        for viewer in viewers:
            viewer._on = False
    kb_s = (viewers[0].bytes - seen) / SECONDS / 1e3
    print(f"page: {none:.1f} % of a core for nobody, {one:.1f} for one viewer of the map, {ten:.1f} for ten; "
          f"{kb_s:.0f} kB/s each")  # fmt: skip
    assert all(viewer.chunks > 3 for viewer in viewers)
    assert ten - one < 5.0


def _health(board, node):
    record = board.records.get(node)
    return None if record is None else record.health
