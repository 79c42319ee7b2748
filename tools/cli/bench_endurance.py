"""Commands `beamsplat bench laps` and `beamsplat bench faults`: the whole system over a long time."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from beamsplat.tools.cli.options import writable

console = Console(stderr=True)
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]
DataOption = Annotated[
    Path | None, typer.Option(help="Bag, recording or folder to play in a loop; default: a simulated lap")
]


def _say(text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _stop_in_order() -> None:
    """Let SIGTERM and SIGHUP end a run as Ctrl-C does, so that no process of it is left behind."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)


def bench_laps(
    minutes: Annotated[float, typer.Option(min=0.5, max=10_000.0, help="Length of the run")] = 60.0,
    data: DataOption = None,
    out: Annotated[
        Path, typer.Option(callback=writable, help="Folder for report.json, report.html, samples.csv")
    ] = Path("out/laps"),
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the router that is started")] = 17448,
    as_json: JsonOption = False,
) -> None:
    """Run the whole system on laps; report the growth of memory, descriptors and threads of each process.

    Exit code 1 if something grew.

    Example: beamsplat bench laps --minutes 60 --out out/laps
    """
    from beamsplat.tools.bench.laps import bench_laps as run

    _stop_in_order()
    report = run(data, minutes, out, f"tcp/127.0.0.1:{port}", _say)
    if as_json:
        print(json.dumps(report))
    else:
        table = Table("process", "private MB", "later", "map explains", "peak", "descriptors", "threads")
        for name, figure in report["processes"].items():
            cells = [
                f"{value:.1f}"
                for value in (*figure["private_mb"], figure["explained_mb"], figure["peak_private_mb"])
            ]
            table.add_row(
                name, *cells, *("{} -> {}".format(*figure[key]) for key in ("descriptors", "threads"))
            )
        Console().print(table)
        print(f"{out / 'report.html'}\n{out / 'report.json'}")
    for finding in report["findings"]:
        _say(finding)
    if report["findings"]:
        raise typer.Exit(1)


def bench_faults(
    minutes: Annotated[
        float, typer.Option(min=0.5, max=10_000.0, help="Time in which faults are injected")
    ] = 20.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random plan of faults")] = 0,
    data: DataOption = None,
    rate: Annotated[float, typer.Option(min=0.1, max=10.0, help="Replay at N times real time")] = 1.0,
    out: Annotated[
        Path,
        typer.Option(callback=writable, help="Folder; each run makes a folder in it, named by its start"),
    ] = Path("out/faults"),
    as_json: JsonOption = False,
) -> None:
    """Run robot and edge server under random faults; report what did not survive.

    The system is the real one: two supervisors, TLS between the hosts, logins within the robot. Faults are
    SIGKILL, SIGSTOP, full, read-only and slow disks, failing fsync, clock steps, sensors with NaN or
    impossible stamps, garbage on every topic, hostile queries, half-open connections, router restarts, and
    cut links.
    Disks and clocks fail within the processes, for Python's own functions; no privileges are needed.

    Exit code 1 if something did not survive; the findings are listed with the faults before them.

    Examples:

        beamsplat bench faults --minutes 20

        beamsplat bench faults --minutes 5 --seed 3 --data drive/bag --rate 0.5
    """
    from beamsplat.tools.bench.faults.campaign import bench_faults as run

    _stop_in_order()
    report = run(data, minutes, seed, out, rate, _say)
    if as_json:
        print(json.dumps(report))
    else:
        _print_campaign(report)
    if report["findings"]:
        raise typer.Exit(1)


def _print_campaign(report: dict[str, Any]) -> None:
    faults, poses, keyframes = report["faults"], report["without_localization_s"], report["keyframes"]
    unexpected = [restart for restart in report["restarts"] if not restart["expected"]]
    table = Table("figure", "value")
    for name, value in (
        ("faults injected", faults["injected"]), ("faults survived", faults["survived"]),
        *((f"  {kind}", count) for kind, count in faults["by_kind"].items()),
        ("without localization, s", f"{poses['total']:.1f}, longest {poses['longest']:.1f}"),
        ("  while localization ran, s", f"{poses['total_while_localization_ran']:.1f}, longest "
                                        f"{poses['longest_while_localization_ran']:.1f}"),
        ("keyframes made", keyframes["made"]), ("keyframes refused with a reason", keyframes["refused"]),
        ("keyframes lost", keyframes["lost"]), ("processes wedged", report["wedged"]),
        ("sessions and maps unreadable", report["unreadable"]),
        ("longest recovery, s", f"{report['recovery_s']['longest']:.1f}"),
        ("restarts by a fault", len(report["restarts"]) - len(unexpected)),
        ("other restarts", len(unexpected)),
    ):  # fmt: skip
        table.add_row(name, str(value))
    Console().print(table)
    processes = Table("process", "private MB", "descriptors", "threads")
    for name, figures in report["processes"].items():
        processes.add_row(name, *("{:.0f} to {:.0f}".format(*figures[key])
                                  for key in ("private_mb", "descriptors", "threads")))  # fmt: skip
    Console().print(processes)
    print(f"{report['folder']}/timeline.svg\n{report['folder']}/report.json")
    for finding in report["findings"]:
        _say(f"{finding['time_s']:.1f} s: {finding['text']}")
        for before in finding["faults_before"]:
            _say(f"    after {before}")
