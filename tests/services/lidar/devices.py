"""Emulated lidars that follow their protocol documents, on a pseudo-terminal or a socket.

They are written from the documents, independently of our parsers, and measure a known room.
"""

import contextlib
import os
import pty
import select
import socket
import struct
import threading
import time
import tty
import zlib

import numpy as np

ROOM = (-2.0, 3.0, -1.5, 2.5)  # x from, x to, y from, y to (m), the lidar at the origin


def room_range_m(angle_rad):
    """Return the range to the walls in directions counter-clockwise from the front."""
    x0, x1, y0, y1 = ROOM
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    with np.errstate(divide="ignore"):
        return np.minimum(np.abs(np.where(c > 0, x1, x0) / c), np.abs(np.where(s > 0, y1, y0) / s))


class Ld19:
    """An LD19: 4500 points/s at 10 revolutions/s, 375 packets/s."""

    point_hz, speed_deg_s = 4500.0, 3600.0

    def __init__(self):
        self.points = 0

    def answer(self, data):
        return b""

    def range_m(self, angle_rad):
        return room_range_m(angle_rad)

    def packet(self):
        step = self.speed_deg_s / self.point_hz
        angle = (self.points + np.arange(12)) * step % 360.0
        mm = np.round(self.range_m(-np.radians(angle)) * 1000).astype(np.uint16)
        self.points += 12
        time_ms = int(self.points / self.point_hz * 1000) % 30000
        body = b"\x54\x2c" + struct.pack("<HH", int(self.speed_deg_s), round(angle[0] * 100) % 36000)
        body += b"".join(struct.pack("<HB", int(d), 200) for d in mm)
        body += struct.pack("<HH", round(angle[-1] * 100) % 36000, time_ms)
        return body + bytes((self._crc(body),))

    @staticmethod
    def _crc(data):
        value = 0
        for byte in data:
            value ^= byte
            for _ in range(8):
                value = (value << 1 ^ 0x4D if value & 0x80 else value << 1) & 0xFF
        return value

    @property
    def seconds(self):
        return self.points / self.point_hz


class Rplidar:
    """An RPLIDAR that answers requests and streams standard nodes, capsules, dense capsules or HQ packets."""

    def __init__(self, kind=0x82, model=0x18, sample_hz=4000.0, turn_hz=5.5):
        self.kind, self.model, self.sample_hz, self.turn_hz = kind, model, sample_hz, turn_hz
        self.samples = 0
        self.scanning = None
        self.requests = []
        self.mode = {0x82: 1, 0x85: 1, 0x83: 2, 0x84: 3}[kind]  # the typical one

    def answer(self, data):
        out, at = b"", 0
        while at < len(data):
            if data[at] != 0xA5 or at + 1 >= len(data):
                at += 1
                continue
            command = data[at + 1]
            payload = b""
            size = 2
            if command & 0x80 and at + 2 < len(data):
                size = 4 + data[at + 2]
                payload = data[at + 3 : at + 3 + data[at + 2]]
            self.requests.append(bytes(data[at : at + size]))
            out += self._respond(command, payload)
            at += size
        return out

    def _respond(self, command, payload):
        if command == 0x25:
            self.scanning = None
        if command == 0x50:
            return self._single(0x04, bytes((self.model, 29, 1, 7)) + bytes(range(16)))
        if command == 0x52:
            return self._single(0x06, bytes(3))
        if command == 0x84 and self.kind != 0x82:
            entry = struct.unpack_from("<I", payload)[0]
            data = {0x7C: struct.pack("<H", self.mode), 0x75: bytes((self.kind,)),
                    0x71: struct.pack("<I", round(256e6 / self.sample_hz))}[entry]  # fmt: skip
            return self._single(0x20, payload[:4] + data)
        if command == 0x20:
            self.scanning = 0x81
        elif command == 0x82:
            asked = payload[0] if payload else 0
            self.scanning = self.kind if asked == (self.mode if self.mode > 1 else 0) else 0x82
        else:
            return b""
        length = {0x81: 5, 0x82: 84, 0x83: 781, 0x84: 132, 0x85: 84}[self.scanning]
        return b"\xa5\x5a" + struct.pack("<I", length | 1 << 30) + bytes((self.scanning,))

    def _single(self, kind, data):
        return b"\xa5\x5a" + struct.pack("<I", len(data)) + bytes((kind,)) + data

    def _angles(self, count):
        turned = (self.samples + np.arange(count)) * self.turn_hz / self.sample_hz
        self.samples += count
        return turned * 360.0

    def packet(self):
        made = {0x81: self._nodes, 0x82: self._capsule, 0x83: self._hq, 0x84: self._ultra, 0x85: self._dense}
        return made[self.scanning]()

    def _mm(self, angle_deg):
        return room_range_m(-np.radians(angle_deg)) * 1000.0

    def _nodes(self):
        out = b""
        for angle in self._angles(10):
            turned = angle % 360.0
            first = turned < 360.0 * self.turn_hz / self.sample_hz
            word = round(turned * 64) % (360 * 64)
            out += struct.pack(
                "<BHH", 47 << 2 | (1 if first else 2), word << 1 | 1, round(self._mm(turned) * 4)
            )
        return out

    def _head(self, start_deg, body):
        rest = struct.pack("<H", round(start_deg * 64) % (360 * 64)) + body
        check = 0
        for byte in rest:
            check ^= byte
        return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + rest

    def _capsule(self):
        angles = self._angles(32)
        offsets = self._offsets_q3(angles)
        words = np.round(self._mm(angles - offsets / 8.0)).astype(int) << 2 | offsets >> 4
        low = offsets & 0xF
        body = b""
        for i in range(0, 32, 2):
            body += struct.pack("<HHB", words[i], words[i + 1], low[i] | low[i + 1] << 4)
        return self._head(angles[0] % 360.0, body)

    def _offsets_q3(self, angles):
        """Return the angle offsets of a triangulation lidar: larger at larger range, up to 8 degrees,
        in 1/8 degree.
        """
        near = 98361.0 / (self._mm(angles) * 4.0) * 64.0 / 65536.0
        return np.clip(np.round((8.0 - np.degrees(near)) * 8.0), 0, 63).astype(int)

    def _ultra(self):
        """Encode cabins of three samples; the third is relative to the next cabin, so one more sample
        is needed.
        """
        angles = self._angles(96)
        ahead = angles[-1] + (np.arange(3) + 1) * 360.0 * self.turn_hz / self.sample_hz
        angles = np.concatenate([angles, ahead])
        seen = self._mm(angles - np.degrees(self._aside(angles)))
        mm = np.round(seen).astype(int).reshape(33, 3)
        steps = [(3328, 1 << 14, 4), (1792, 1 << 12, 3), (1280, 1 << 11, 2), (512, 1 << 9, 1), (0, 0, 0)]
        codes, values, shifts = [], [], []
        for distance in mm[:, 0]:
            code, value, shift = next(step for step in steps if distance >= step[1])
            codes.append(code + (distance - value >> shift))
            values.append(value + (distance - value >> shift << shift))
            shifts.append(shift)
        body = b""
        for i in range(32):
            one = self._difference(mm[i, 1] - values[i], shifts[i])
            two = self._difference(mm[i, 2] - values[i + 1], shifts[i + 1])
            body += struct.pack("<I", codes[i] | one << 12 | two << 22)
        return self._head(angles[0] % 360.0, body)

    @staticmethod
    def _difference(mm, shift):
        scaled = int(mm) >> shift
        return scaled & 0x3FF if -512 < scaled < 511 else 0x1FF  # out of range: invalid

    def _aside(self, angles):
        """Return the angle (rad) that the host subtracts in ULTRA mode, by the range of the beam's end."""
        aside = np.full(len(angles), np.radians(6.5))
        for _ in range(6):
            q2 = self._mm(angles - np.degrees(aside)) * 4.0
            k = np.floor(98361 / q2)
            aside = np.radians(8.0) - k * 64 / 65536 - np.floor(k**3 / 98304) / 65536
        return aside

    def _dense(self):
        angles = self._angles(40)
        return self._head(angles[0] % 360.0, np.round(self._mm(angles)).astype("<u2").tobytes())

    def _hq(self):
        angles = self._angles(96) % 360.0
        nodes = np.zeros(96, [("angle", "<u2"), ("mm", "<u4"), ("quality", "u1"), ("flag", "u1")])
        nodes["angle"] = np.round(angles * 16384 / 90).astype(int) % 65536
        nodes["mm"], nodes["quality"], nodes["flag"] = np.round(self._mm(angles) * 4), 188, 2
        body = b"\xa5" + struct.pack("<Q", round(self.seconds * 1e6)) + nodes.tobytes()
        return body + struct.pack("<I", zlib.crc32(body + bytes(-len(body) % 4)))

    @property
    def seconds(self):
        return self.samples / self.sample_hz


class Hokuyo:
    """A UST-10LX according to SCIP 2.2: 1081 steps over 270 degrees, 40 scans/s."""

    steps, first, last, front, rpm = 1440, 0, 1080, 540, 2400

    def __init__(self):
        self.scans = 0
        self.scanning = None
        self._line = b""

    @staticmethod
    def _sum(text):
        return bytes(((sum(text) & 0x3F) + 0x30,))

    def answer(self, data):
        out = b""
        self._line += data
        while b"\n" in self._line:
            line, _, self._line = self._line.partition(b"\n")
            out += self._respond(line.strip())
        return out

    def _respond(self, line):
        if line == b"QT":
            self.scanning = None
            return b"QT\n00P\n\n"
        if line == b"PP":
            values = {"MODL": "UST-10LX", "DMIN": 20, "DMAX": 30000, "ARES": self.steps, "AMIN": self.first,
                      "AMAX": self.last, "AFRT": self.front, "SCAN": self.rpm}  # fmt: skip
            lines = [f"{k}:{v}".encode() for k, v in values.items()]
            return b"PP\n00P\n" + b"".join(x + b";" + self._sum(x) + b"\n" for x in lines) + b"\n"
        if line[:2] in (b"MD", b"ME"):
            self.scanning = line
            return line + b"\n00P\n\n"
        return line + b"\n0Ee\n\n"

    def packet(self):
        angle = (np.arange(self.first, self.last + 1) - self.front) * 2 * np.pi / self.steps
        mm = np.round(room_range_m(angle) * 1000).astype(int)
        text = b"".join(bytes((0x30 + (d >> 12), 0x30 + (d >> 6 & 63), 0x30 + (d & 63))) for d in mm.tolist())
        time_ms = int(self.seconds * 1000) % (1 << 24)
        stamp = bytes(0x30 + (time_ms >> shift & 63) for shift in (18, 12, 6, 0))
        self.scans += 1
        blocks = b"".join(
            text[i : i + 64] + self._sum(text[i : i + 64]) + b"\n" for i in range(0, len(text), 64)
        )
        return self.scanning + b"\n99b\n" + stamp + self._sum(stamp) + b"\n" + blocks + b"\n"

    @property
    def seconds(self):
        return self.scans * 60.0 / self.rpm


def corrupt_bytes(data, rng, share):
    """Return `data` with a ratio of its bytes replaced by random other ones."""
    array = np.frombuffer(data, np.uint8).copy()
    hit = rng.random(len(array)) < share
    array[hit] ^= rng.integers(1, 256, hit.sum()).astype(np.uint8)
    return array.tobytes()


class EmulatedPort:
    """Runs a device in real time behind a pseudo-terminal that can be removed, or behind a TCP port."""

    def __init__(self, device, path=None, corruption=0.0, seed=0):
        self.device, self.path, self.corruption = device, path, corruption
        self._rng = np.random.default_rng(seed)
        self._stop = threading.Event()
        self._thread = None
        if path is None:
            self._listener = socket.create_server(("127.0.0.1", 0))
            self.port = self._listener.getsockname()[1]

    def __enter__(self):
        self.plug()
        return self

    def __exit__(self, *exception):
        self.unplug()
        if self.path is None:
            self._listener.close()

    def plug(self):
        self._stop.clear()
        if self.path is not None:
            self._master, self._slave = pty.openpty()
            tty.setraw(self._slave)
            os.symlink(os.ttyname(self._slave), self.path)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self):
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join(5)
        self._thread = None
        if self.path is not None:
            os.unlink(self.path)
            os.close(self._slave)
            os.close(self._master)

    def _run(self):
        if self.path is not None:
            self._serve(self._master, lambda n: os.read(self._master, n), self._write_master)
            return
        while not self._stop.is_set():
            if not select.select([self._listener], [], [], 0.02)[0]:
                continue
            connection, _ = self._listener.accept()
            with connection, contextlib.suppress(OSError):
                self._serve(connection, connection.recv, connection.sendall)

    def _write_master(self, data):
        with contextlib.suppress(BlockingIOError):  # no reader: a UART loses the bytes
            os.set_blocking(self._master, False)
            os.write(self._master, data)

    def _serve(self, handle, read, write):
        began, at_start = time.monotonic(), self.device.seconds
        while not self._stop.is_set():
            if select.select([handle], [], [], 0.002)[0]:
                data = read(4096)
                if not data:
                    return
                answer = self.device.answer(data)
                if answer:
                    write(corrupt_bytes(answer, self._rng, self.corruption))
                    began, at_start = time.monotonic(), self.device.seconds
            if getattr(self.device, "scanning", True) is None:
                began, at_start = time.monotonic(), self.device.seconds
                continue
            while self.device.seconds - at_start < time.monotonic() - began and not self._stop.is_set():
                write(corrupt_bytes(self.device.packet(), self._rng, self.corruption))
