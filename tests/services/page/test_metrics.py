"""Metrics: values in base units, read by the parser of the Prometheus client from a real page."""

import math
import re
import time
import urllib.request
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from beamsplat.common.messages import Health, InputHealth, NodeFigure, OutputHealth, Rejected
from beamsplat.common.messages.instances import process_of
from beamsplat.services.page.metrics import FAMILIES, MetricsText
from tests.services.page.test_page_server import Serving

DOCS = Path(__file__).resolve().parents[3] / "docs" / "metrics.md"
NASTY = 'a "quoted" \\ text\nwith a line'


def health(node, *, epoch=1, received=0, sent=0, **fields):
    process = process_of(b"seed", node, epoch)
    scan = InputHealth(
        topic="lidar/scan", received=received, dropped=2, lost=3, undecodable=4, stale=5, age_ms=80.0, late=6,
        refused=7,
    )  # fmt: skip
    return Health(
        stamp_ns=1, node=node, instance=process.instance, epoch=epoch, inputs=(scan,),
        outputs=(OutputHealth(topic="localization/odometry", sent=sent, bytes=100 * sent, refused=1),),
        **{"state": "active", "step_p50_ms": 1.5, "step_p95_ms": 20.0, "rss_mb": 50.0, "cpu_percent": 25.0, **fields},
    )  # fmt: skip


def figures(**values):
    return tuple(NodeFigure(name=name, value=value) for name, value in values.items())


def scrape(serving):
    """Read /metrics; return {(name, sorted labels): value}, and the families by name."""
    with urllib.request.urlopen(f"http://127.0.0.1:{serving.port}/metrics", timeout=10) as reply:
        assert reply.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
        families = list(text_string_to_metric_families(reply.read().decode()))
    samples = {}
    for family in families:
        for sample in family.samples:
            key = sample.name.removeprefix("beamsplat_"), tuple(sorted(sample.labels.items()))
            assert key not in samples, f"twice: {key}"
            samples[key] = sample.value
    return samples, {family.name: family for family in families}


def value(samples, name, **labels):
    return samples[name, tuple(sorted(labels.items()))]


def test_health_is_exported_in_base_units():
    with Serving() as serving:
        serving.state.health(health("localization", status="lost: 3 beams", rejected=(
            Rejected(topic="localization/odometry", reason=NASTY, count=9),
        )))  # fmt: skip
        samples, families = scrape(serving)
        node = {"robot": "r0", "node": "localization"}
        scan, pose = {**node, "topic": "lidar/scan"}, {**node, "topic": "localization/odometry"}
        assert value(samples, "node_up", **node) == 1.0
        assert value(samples, "node_state", **node, state="active") == 1.0
        assert value(samples, "node_state", **node, state="silent") == 0.0
        assert value(samples, "node_step_seconds", **node, quantile="0.5") == pytest.approx(0.0015)
        assert value(samples, "node_step_seconds", **node, quantile="0.95") == pytest.approx(0.020)
        assert value(samples, "node_resident_memory_bytes", **node) == 50e6
        assert value(samples, "node_cpu_cores", **node) == 0.25
        assert value(samples, "node_input_age_seconds", **scan) == pytest.approx(0.080)
        dropped = {"overtaken": 2, "lost": 3, "undecodable": 4, "stale": 5, "other_process": 7}
        for reason, count in dropped.items():
            assert value(samples, "node_dropped_total", **scan, reason=reason) == count
        assert value(samples, "node_dropped_total", **pose, reason="too_large") == 1
        assert value(samples, "node_late_total", **scan) == 6
        assert value(samples, "node_rejected_total", **pose, reason=NASTY) == 9
        status = {s: value(samples, "localization_status", robot="r0", status=s) for s in ("ok", "lost")}
        assert status == {"ok": 0.0, "lost": 1.0}
        assert families["beamsplat_node_dropped"].type == "counter"
        assert families["beamsplat_node_step_seconds"].type == "gauge"


def test_counters_and_rates_follow_the_reports_and_restarts_are_counted():
    with Serving() as serving:
        node = {"robot": "r0", "node": "localization"}
        scan = {**node, "topic": "lidar/scan"}
        start = _now() - 3.0
        for second in range(4):
            report = health("localization", received=10 * second, sent=5 * second)
            serving.state._health.add(report, start + second)
        samples, _ = scrape(serving)
        assert value(samples, "node_input_messages_total", **scan) == 30
        assert value(samples, "node_input_rate_hertz", **scan) == pytest.approx(10.0, rel=1e-6)
        pose = {**node, "topic": "localization/odometry"}
        assert value(samples, "node_output_rate_hertz", **pose) == pytest.approx(5.0, rel=1e-6)
        assert value(samples, "node_output_bytes_total", **pose) == 1500
        assert value(samples, "node_restarts_total", **node) == 0
        serving.state.health(health("localization", epoch=2))
        samples, _ = scrape(serving)
        assert value(samples, "node_restarts_total", **node) == 1
        assert value(samples, "node_input_messages_total", **scan) == 0


def test_figures_of_all_robots_are_exported_and_unknown_names_are_not():
    with Serving() as serving:
        both = figures(link_up=0.0, outbox_keyframes=12, disk_free_bytes=2.5e9, hostile_name=1.0)
        serving.fleet.state_of("r1").health(health("uplink", figures=(*both, *figures(link_up=1.0))))
        serving.state.health(
            health("mapping", figures=figures(map_gaussians=123456, map_psnr_decibels=24.25))
        )
        samples, _ = scrape(serving)
        there = {"robot": "r1", "node": "uplink"}
        assert value(samples, "outbox_keyframes", **there) == 12
        assert value(samples, "disk_free_bytes", **there) == 2.5e9
        assert value(samples, "link_up", **there) == 1.0, "a name that is sent twice is exported once"
        assert value(samples, "map_gaussians", robot="r0", node="mapping") == 123456
        assert value(samples, "map_psnr_decibels", robot="r0", node="mapping") == 24.25
        assert not any("hostile" in name for name, _ in samples)


def test_of_a_silent_node_only_its_state_is_exported():
    with Serving() as serving:
        serving.state._health.add(health("depth", figures=figures(disk_free_bytes=1.0)), _now() - 60.0)
        samples, _ = scrape(serving)
        node = {"robot": "r0", "node": "depth"}
        assert value(samples, "node_up", **node) == 0.0
        assert value(samples, "node_state", **node, state="silent") == 1.0
        assert value(samples, "node_report_age_seconds", **node) == pytest.approx(60.0, abs=5.0)
        assert not {"node_resident_memory_bytes", "disk_free_bytes"} & {name for name, _ in samples}


def test_active_alerts_are_exported_and_all_other_kinds_are_zero():
    with Serving() as serving:
        serving.state.health(health("depth", state="failed", detail="no model"))
        for now in (_now(), _now() + 11.0):
            serving.alerting.update(now, 1e9)
            serving.state.health(health("depth", state="failed", detail="no model"))
        samples, _ = scrape(serving)
        assert value(samples, "alert_active", robot="r0", alert="node_failed", node="depth") == 1.0
        assert value(samples, "alert_active", robot="r0", alert="lost", node="") == 0.0
        assert value(samples, "alert_active", robot="r1", alert="node_failed", node="") == 0.0


def test_the_page_itself_is_exported():
    with Serving() as serving, serving.open_event_stream() as stream:
        assert stream.recv(10)
        samples, families = scrape(serving)
        assert value(samples, "page_viewers") == 1
        assert value(samples, "page_refused_total", reason="commands rejected for a wrong token") == 0
        assert families["beamsplat_build_info"].samples[0].value == 1


def test_numbers_keep_their_precision():
    out = MetricsText()
    for number, text in (
        (2**52 + 1, "4503599627370497"),
        (0.1, "0.1"),
        (math.nan, "NaN"),
        (-math.inf, "-Inf"),
    ):
        out.add("page_viewers", number)
        assert out.text().decode().splitlines()[-1] == f"beamsplat_page_viewers {text}"


def test_every_metric_is_documented_with_its_type_and_text():
    rows = [line.split(" | ") for line in DOCS.read_text().splitlines() if line.startswith("| `beamsplat_")]
    documented = {
        row[0].strip("|` "): (re.split(r"[,;]", row[1])[0], row[2].removesuffix(" |")) for row in rows
    }
    assert documented == {f"beamsplat_{name}": family for name, family in FAMILIES.items()}


def _now():
    return time.monotonic()
