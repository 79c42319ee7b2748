"""Camera node with faults: changed image size, low rate, damaged images, disconnection."""

import http.server
import threading
import time

import cv2
import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages.image_header import is_complete_image
from beamsplat.services.camera.config import CameraConfig, NoCameraConfig
from beamsplat.services.camera.jpeg import is_intact
from beamsplat.services.camera.node import CameraNode, NoCamera
from tests.services.lidar.test_live import RunningSource

RIG = """
[camera]
width_px = 64
height_px = 48
fx_px = 50.0
fy_px = 50.0
cx_px = 31.5
cy_px = 23.5
[camera.mount]
xyz_m = [0.1, 0.0, 0.3]
rpy_deg = [0.0, 0.0, 0.0]
[lidar.mount]
xyz_m = [0.0, 0.0, 0.2]
rpy_deg = [0.0, 0.0, 0.0]
"""


def jpeg(number, width=64, height=48):
    """Return a JPEG of smooth noise that depends on `number`."""
    noise = np.random.default_rng(number).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 2.0))[1].tobytes()


class EmulatedCamera:
    """An emulated network camera: MJPEG over HTTP, with faults to switch on."""

    def __init__(self):
        self.rate_hz, self.size, self.damage = 25.0, (64, 48), None
        self.sent = []
        self.port = 0
        self._server = None

    def plug(self):
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=--here")
                self.end_headers()
                alive = camera._server
                while camera._server is alive:
                    data = jpeg(len(camera.sent), *camera.size)
                    if camera.damage is not None:
                        data = camera.damage(data)
                    camera.sent.append(data)
                    head = f"--here\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    try:
                        self.wfile.write(head.encode() + data + b"\r\n")
                    except OSError:
                        return
                    time.sleep(1.0 / camera.rate_hz)

            def log_message(self, *args):
                pass

        class Server(http.server.ThreadingHTTPServer):
            daemon_threads = True
            allow_reuse_address = True

        self._server = Server(("127.0.0.1", self.port), Handler)
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def unplug(self):
        server, self._server = self._server, None
        if server is not None:
            server.shutdown()
            server.server_close()

    def __enter__(self):
        self.plug()
        return self

    def __exit__(self, *exception):
        self.unplug()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}/video"


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


def _images(running):
    return [(at, m) for at, m in running.messages if type(m).__name__ == "Image"]


def test_jpegs_are_published_unchanged_after_the_calibration(rig):
    with (
        EmulatedCamera() as camera,
        RunningSource(CameraNode(CameraConfig(source=camera.url, rig=rig))) as running,
    ):
        running.wait(lambda: len(_images(running)) >= 5)
    sent = set(camera.sent)
    first = running.messages[0][1]
    assert (type(first).__name__, first.camera.width_px) == ("Rig", 64)
    for _, image in _images(running):
        assert bytes(image.data) in sent
        assert (image.width_px, image.height_px, image.encoding) == (64, 48, "jpeg")
    stamps = [image.stamp_ns for _, image in _images(running)]
    assert sorted(set(stamps)) == stamps
    assert abs(time.time_ns() - stamps[-1]) < 60e9
    assert "Hz" in running.node.detail


def test_images_of_another_size_than_the_calibration_are_rejected(rig):
    with (
        EmulatedCamera() as camera,
        RunningSource(CameraNode(CameraConfig(source=camera.url, rig=rig))) as running,
    ):
        running.wait(lambda: len(_images(running)) >= 2)
        camera.size = (32, 24)
        running.wait(lambda: "rejected (32x24 px, the calibration is for 64x48)" in running.node.detail)
        camera.size = (64, 48)
        before = len(_images(running))
        running.wait(lambda: len(_images(running)) >= before + 2)
    assert {(m.width_px, m.height_px) for _, m in _images(running)} == {(64, 48)}


def test_the_status_reports_a_slow_camera(rig):
    config = CameraConfig(source="", rig=rig, rate_hz=25.0)
    with EmulatedCamera() as camera:
        camera.rate_hz = 2.0
        node = CameraNode(config.model_copy(update={"source": camera.url}))
        with RunningSource(node) as running:
            running.wait(lambda: "SLOW, 25 Hz requested" in node.detail)
            camera.rate_hz = 25.0
            running.wait(lambda: "SLOW" not in node.detail and "Hz" in node.detail)
    assert "reopened" not in node.detail  # 2 Hz is slow, not gone


def test_damaged_images_are_rejected(rig):
    rng = np.random.default_rng(0)

    def cut(data):
        return data[: rng.integers(1, len(data))] if rng.random() < 0.5 else data

    with EmulatedCamera() as camera:
        camera.damage = cut
        node = CameraNode(CameraConfig(source=camera.url, rig=rig))
        with RunningSource(node) as running:
            running.wait(lambda: len(_images(running)) >= 10 and "rejected (damaged)" in node.detail)
    counts = {entry.reason: entry.count for entry in node.rejections.report()}
    assert counts["images rejected: damaged"] > 0
    for _, image in _images(running):
        assert cv2.imdecode(np.asarray(image.data), cv2.IMREAD_COLOR).shape == (48, 64, 3)
        assert is_complete_image(bytes(image.data))
        assert is_intact(bytes(image.data))


def test_a_disconnected_camera_is_reopened(rig):
    with EmulatedCamera() as camera:
        node = CameraNode(CameraConfig(source=camera.url, rig=rig))
        with RunningSource(node) as running:
            running.wait(lambda: len(_images(running)) >= 2)
            camera.unplug()
            running.wait(lambda: "NOT CONNECTED" in node.detail)  # after an attempt to open it again
            before = len(_images(running))
            camera.plug()
            running.wait(lambda: len(_images(running)) >= before + 2)
            running.wait(lambda: "reopened 1 times" in node.detail)
    stamps = [image.stamp_ns for _, image in _images(running)]
    assert sorted(set(stamps)) == stamps


def test_a_camera_without_images_is_disconnected(rig):
    with EmulatedCamera() as camera:
        node = CameraNode(CameraConfig(source=camera.url, rig=rig, silence_s=0.5))
        with RunningSource(node) as running:
            running.wait(lambda: len(_images(running)) >= 2)
            camera.rate_hz = 0.05
            running.wait(lambda: "DISCONNECTED: no image for 0.5 s" in node.detail)


def test_stamps_do_not_depend_on_the_wall_clock(rig, monkeypatch):
    wall = {"offset": 0}
    real = time.time_ns
    monkeypatch.setattr("time.time_ns", lambda: real() + wall["offset"])
    with EmulatedCamera() as camera:
        node = CameraNode(CameraConfig(source=camera.url, rig=rig))
        with RunningSource(node) as running:
            for offset_h in (0, 1, -1):
                wall["offset"] = offset_h * 3600 * 10**9
                before = len(_images(running))
                running.wait(lambda enough=before + 4: len(_images(running)) >= enough)
    stamps = np.array([image.stamp_ns for _, image in _images(running)])
    assert np.diff(stamps).min() > 0
    assert np.diff(stamps).max() < 5e9


@pytest.mark.parametrize("codec", ["MJPG", "mp4v"])
def test_a_video_file_is_read_to_its_end(tmp_path, codec):
    path = tmp_path / ("video.avi" if codec == "MJPG" else "video.mp4")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 20.0, (64, 48))
    for i in range(12):
        writer.write(cv2.imdecode(np.frombuffer(jpeg(i), np.uint8), cv2.IMREAD_COLOR))
    writer.release()
    node = CameraNode(CameraConfig(source=str(path)))
    node.configure()
    started = time.monotonic()
    images = [item.message for item in node.source() if item is not None]
    assert time.monotonic() - started > 0.4  # at its own speed
    assert len(images) + node._reader.dropped >= 11
    assert len(images) >= 8
    assert "end of file" in node.detail
    if codec == "MJPG":  # undecoded: each picture's bytes stand in the file as they are
        assert bytes(images[3].data) in path.read_bytes()
    node.close()


def test_the_status_reports_missing_cameras(tmp_path, rig):
    for source, said in (
        (str(tmp_path / "no.avi"), "no such file"), ("/dev/video77", "no such camera"), ("77", "no such camera"),
        ("http://127.0.0.1:9/video", "does not answer"),
    ):  # fmt: skip
        node = CameraNode(CameraConfig(source=source))
        with RunningSource(node) as running:
            running.wait(lambda n=node, s=said: s in n.detail)
            assert "NOT CONNECTED" in node.detail
            assert "NO CALIBRATION" in node.detail
    rig.write_text(RIG[RIG.index("[lidar") :])
    with pytest.raises(UserError, match="\\[camera\\] is missing"):
        CameraNode(CameraConfig(rig=rig)).configure()


def test_without_a_camera_the_rig_is_published(rig):
    rig.write_text(RIG[RIG.index("[lidar") :])
    node = NoCamera(NoCameraConfig(rig=rig))
    node.configure()
    source = node.source()
    message = next(source).message
    assert message.camera is None
    assert message.lidar.T_body_lidar[2, 3] == 0.2
    assert next(source) is None


@pytest.mark.parametrize(
    "options",
    [
        [],
        [cv2.IMWRITE_JPEG_QUALITY, 40],
        [cv2.IMWRITE_JPEG_RST_INTERVAL, 3],
        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    ],
)
def test_every_complete_jpeg_is_accepted(options):
    for shape in ((48, 64, 3), (47, 61, 3), (33, 8), (480, 640, 3)):
        noise = np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)
        for image in (noise, cv2.GaussianBlur(noise, (0, 0), 3.0)):
            assert is_intact(cv2.imencode(".jpg", image, options)[1].tobytes())
    assert is_intact(jpeg(0) + b"\0" * 100)  # padded as cameras do


def test_detection_rates_of_damaged_jpegs():
    """The detection rates that docs/sensors.md states."""
    rng = np.random.default_rng(0)
    data = jpeg(3, 320, 240)
    noticed = dict.fromkeys(("cut off", "512 bytes lost", "1 % wrong", "one byte wrong"), 0)
    for _ in range(100):
        at = int(rng.integers(700, len(data) - 600))
        wrong = np.frombuffer(data, np.uint8).copy()
        hit = rng.random(len(wrong)) < 0.01
        wrong[hit] ^= rng.integers(1, 256, hit.sum()).astype(np.uint8)
        single = bytearray(data)
        single[at] ^= int(rng.integers(1, 256))
        for name, damaged in (
            ("cut off", data[:at] + b"\xff\xd9"), ("512 bytes lost", data[:at] + data[at + 512 :]),
            ("1 % wrong", wrong.tobytes()), ("one byte wrong", bytes(single)),
        ):  # fmt: skip
            noticed[name] += not is_intact(damaged)
    assert noticed["cut off"] >= 98
    assert noticed["1 % wrong"] >= 95
    assert noticed["512 bytes lost"] >= 90
    assert noticed["one byte wrong"] >= 15
