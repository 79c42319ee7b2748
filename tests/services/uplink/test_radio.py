"""The emulated radio: delay, loss, cut."""

import json
import subprocess
import sys

from tests.services.uplink.radio import FAR_ADDRESS, Radio, needs_namespaces

COUNT, DELAY_MS = 300, 30.0
_RECEIVE = f"""
import json, socket, time
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
    ear.bind(("{FAR_ADDRESS}", 5000))
    print("ready", flush=True)
    heard = {{}}
    while True:
        number, sent_ns = ear.recv(64).decode().split()
        if number == "end":
            break
        heard[int(number)] = (time.monotonic_ns() - int(sent_ns)) / 1e6
    print(json.dumps(heard))
"""
_SEND = f"""
import socket, sys, time
numbers = range(*map(int, sys.argv[1:3])) if len(sys.argv) > 2 else ["end"] * 20
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth:
    mouth.bind(("", 5001))
    for number in numbers:
        mouth.sendto(f"{{number}} {{time.monotonic_ns()}}".encode(), ("{FAR_ADDRESS}", 5000))
        time.sleep(0.001)
"""


def heard_over(radio, cut=False):
    """Return datagram number -> delay in ms; with `cut` the second half is sent during a cut."""

    def send(*numbers):
        subprocess.run(radio.on(radio.near, sys.executable, "-c", _SEND, *map(str, numbers)), check=True)

    ear = subprocess.Popen(
        radio.on(radio.far, sys.executable, "-c", _RECEIVE), stdout=subprocess.PIPE, text=True
    )
    assert ear.stdout.readline() == "ready\n"
    send(0, COUNT // 2)
    if cut:
        radio.tell("cut")
    send(COUNT // 2, COUNT)
    radio.tell("mend")
    send()
    return {int(k): v for k, v in json.loads(ear.communicate(timeout=20)[0]).items()}


def test_delay_and_reproducible_loss():
    needs_namespaces()
    heard = []
    for seed in (3, 3, 4):
        with Radio(rate_mbit=20, delay_ms=DELAY_MS, loss=0.1, seed=seed) as radio:
            heard.append(heard_over(radio))
    assert all(min(run.values()) >= DELAY_MS for run in heard)
    lost = [set(range(COUNT)) - set(run) for run in heard]
    assert lost[0] == lost[1] != lost[2]
    assert all(10 <= len(numbers) <= 60 for numbers in lost)  # of 30 expected; three sigma are 16


def test_no_packet_crosses_during_a_cut():
    needs_namespaces()
    with Radio() as radio:
        heard = heard_over(radio, cut=True)
        there, _ = radio.tell("count")
    assert set(heard) == set(range(COUNT // 2))
    assert there["cut"] == COUNT // 2
    assert there["lost"] == 0
