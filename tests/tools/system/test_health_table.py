"""What `top` and `topics` show is what the nodes report."""

import pytest
from rich.console import Console

from beamsplat.common.config.alerts import AlertConfig, alert_rules
from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health, InputHealth, OutputHealth
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.tools.system.health_table import ALL, HealthTable
from tests.common.polling import wait_until


def _text(table, width=80):
    console = Console(width=width, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(table)
    return console.export_text()


def _health(node, sent, lost=0, state="active", **inputs):
    takes = InputHealth(
        topic="lidar/scan", received=sent, dropped=3, lost=lost, undecodable=0, stale=0, age_ms=1.5
    )
    return Health(
        stamp_ns=1, node=node, instance="ab" * 8, epoch=1, state=state, detail="warm and well",
        inputs=(takes,) if node == "localization" else (),
        outputs=(OutputHealth(topic="lidar/scan", sent=sent, bytes=1000 * sent),) if node == "replay" else (),
        step_p50_ms=1000.0, step_p95_ms=2000.0, rss_mb=1000.0, cpu_percent=100.0, pid=4194304,
    )  # fmt: skip


def test_rates_losses_and_silence_are_shown(free_endpoint):
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as watcher:
        clock_s = [0.0]
        board = HealthTable(watcher, "r", lambda: clock_s[0])
        sender = Bus(open_session((free_endpoint,)), "r", "replay", "ab" * 8, 1)
        taker = Bus(open_session((free_endpoint,)), "r", "localization", "cd" * 8, 1)
        with sender, taker:
            for clock_s[0], sent in ((0.0, 0), (1.0, 10)):

                def received(sent=sent):
                    sender.publish_health(_health("replay", sent))
                    taker.publish_health(_health("localization", sent, lost=2))
                    records = [board.records.get(node) for node in ("replay", "localization")]
                    return all(records) and (
                        records[0].health.outputs[0].sent == records[1].health.inputs[0].received == sent
                    )

                wait_until(received)
            assert board.states() == {"replay": "active", "localization": "active"}
            nodes = _text(board.nodes_table())
            row = next(line for line in nodes.splitlines() if line.strip().startswith("localization"))
            assert row.split()[1:3] == ["4194304", "active"]
            assert row.split()[3] == "10.0"  # 10 messages in one second
            assert row.split()[-4:-2] == ["2", "0"]  # lost, broken
            assert "localization: warm and well" in nodes
            topics = _text(board.topics_table())
            assert "localization 1.5, 3" in topics
            assert "2 lost" in topics
            assert "…" not in nodes + topics  # nothing is cut off in 80 columns

            def silent():
                clock_s[0] += 3.2  # again, if a report was still in transit
                return board.states() == {"replay": "silent", "localization": "silent"}

            wait_until(silent)
            assert "silent" in _text(board.nodes_table())


def test_a_fleet_is_shown_by_robot_and_kept_apart(free_endpoint):
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as watcher:
        fleet, one = HealthTable(watcher, ALL), HealthTable(watcher, "r2")
        buses = {
            name: Bus(open_session((free_endpoint,)), name, "replay", "ab" * 8, 1)
            for name in ("r1", "r2", "r3")
        }

        def received():
            for number, bus in enumerate(buses.values()):
                bus.publish_health(_health("replay", number))
            return len(fleet.states()) == 3 and len(one.states()) == 1

        wait_until(received)
        assert fleet.states() == dict.fromkeys(("r1/replay", "r2/replay", "r3/replay"), "active")
        assert one.states() == {"replay": "active"}
        assert [o.sent for o in one.records["replay"].health.outputs] == [1]
        assert "r3/replay" in _text(fleet.nodes_table())
        for bus in buses.values():
            bus.session.close()


def test_alerts_are_shown_first_as_pending_and_then_as_active(free_endpoint):
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as watcher:
        clock_s = [0.0]
        one, fleet = (HealthTable(watcher, robot, lambda: clock_s[0]) for robot in ("r1", ALL))
        lost = _health("localization", 1).model_copy(update={"status": "lost: 3 beams match"})
        with Bus(open_session((free_endpoint,)), "r1", "localization", "cd" * 8, 1) as bus:

            def reported(at):
                """Whether both tables have a report of the time `at`; one is sent."""
                bus.publish_health(lost)
                known = [
                    name.records.get(node)
                    for name, node in ((one, "localization"), (fleet, "r1/localization"))
                ]
                return all(record and record.received_s == at for record in known)

            wait_until(lambda: reported(0.0))
            assert "pending alert lost (0 s): localization: lost: 3 beams match" in _text(one.nodes_table())
            assert "r1: pending alert lost" in _text(fleet.nodes_table())
            clock_s[0] = 11.0
            wait_until(lambda: reported(11.0))
            assert "\nALERT lost (11 s): localization: lost: 3 beams match" in _text(one.nodes_table())
            (alert,) = one.snapshot()["alerts"]
            facts = ("robot", "alert", "node", "state", "text")
            assert [alert[f] for f in facts] == [
                "r1", "lost", "localization", "active", "localization: lost: 3 beams match",
            ]  # fmt: skip


def test_the_rules_of_the_alerts_come_from_the_deployment():
    deployment = Deployment(nodes={"page": {"alerts": {"hold_s": 3.5, "off": ["lost"]}}})
    rules = alert_rules(deployment, "robot.toml")
    assert (rules.hold_s, rules.clear_s, rules.off) == (3.5, 10.0, ("lost",))
    assert alert_rules(Deployment(), "robot.toml") == AlertConfig()
    wrong = Deployment(nodes={"page": {"alerts": {"hold": 1}}})
    with pytest.raises(UserError, match=r"robot.toml: unknown option 'hold' \(options are: clear_s, "):
        alert_rules(wrong, "robot.toml")
