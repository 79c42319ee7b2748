"""Images and CameraInfo as drivers publish them: used rightly, or one sentence says why not."""

import struct

import cv2
import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.recording.camera_info import is_rectified
from beamsplat.services.replay.bag_source import BagSource
from beamsplat.services.replay.bags import Bag
from beamsplat.services.replay.inspection import inspect
from beamsplat.services.replay.options import SourceOptions
from tests.services.replay.make_bags import (
    LAG_NS,
    START_NS,
    Drive,
    RobotBag,
    camera_info,
    edges_of,
    laser_scan,
)

FX, WIDTH, HEIGHT = 50.0, 64, 48


def scene() -> np.ndarray:
    """A smooth picture in colour, RGB uint8 [48, 64, 3]; its upper left corner is dark and red."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    rgb = np.stack([60 + 2 * u, 40 + 3 * v, 200 - 1.5 * u - 1.5 * v], axis=-1)
    return np.clip(rgb, 0, 255).astype(np.uint8)


def jpeg(rgb: np.ndarray) -> np.ndarray:
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].ravel()


def with_exif(data: np.ndarray, orientation: int) -> np.ndarray:
    """Add an EXIF orientation to a JPEG."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    block = b"Exif\0\0" + tiff
    raw = data.tobytes()
    return np.frombuffer(
        raw[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + raw[2:], np.uint8
    )


def write(path, images, infos=None, topic="/camera/image_raw"):
    """Write an MCAP bag; `images`: dicts of fields of Image or CompressedImage, `infos`: of CameraInfo."""
    bag = RobotBag(path, "mcap")
    with bag.writer:
        bag.write("/tf_static", bag.tf(START_NS, edges_of(Drive())), START_NS)
        for i, fields in enumerate(images):
            at = START_NS + i * 10**8
            info = (infos or [{}] * len(images))[i]
            info = {"fx": FX, "size": (WIDTH, HEIGHT), "centre": (31.5, 23.5)} | info
            bag.write("/camera/camera_info", camera_info(bag, at, **info), at)
            header = bag.header(at, "camera_optical_frame")
            kind = "CompressedImage" if "format" in fields else "Image"
            name = f"{topic}/compressed" if kind == "CompressedImage" else topic
            bag.write(name, bag.new(f"sensor_msgs/msg/{kind}", header=header, **fields), at + 1)
            bag.write("/scan", laser_scan(bag, i, at), at + LAG_NS)
    return path


def raw(encoding, data, step, width=WIDTH, height=HEIGHT, big_endian=0):
    return {
        "encoding": encoding, "data": np.ascontiguousarray(data).view(np.uint8).ravel(), "step": step,
        "width": width, "height": height, "is_bigendian": big_endian,
    }  # fmt: skip


def compressed(data, stated="jpeg"):
    return {"format": stated, "data": np.asarray(data, np.uint8)}


def read(path, **options):
    """Return (rig, images as RGB, problems) as replay reads the bag, and check that `info` says the same."""
    with Bag(path) as bag:
        source = BagSource(bag, SourceOptions(**options))
        rig = source.rig()
        messages = [m for _, topic, m in source.messages() if topic == "camera/image"]
        images = [
            decode_rgb(m.data, m.encoding, m.width_px, m.height_px, m.step_bytes).astype(int)
            for m in messages
        ]
        problems = source.problems
    report = inspect(path, SourceOptions(**options))
    assert report.error == ""
    assert set(problems) <= set(report.problems)
    return rig, images, problems


def uyvy(rgb):
    planes = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    u, v = (np.repeat(c, 2, axis=0) for c in planes[HEIGHT:].reshape(2, HEIGHT // 2, WIDTH // 2))
    out = np.empty((HEIGHT, WIDTH, 2), np.uint8)
    out[..., 1], out[:, 0::2, 0], out[:, 1::2, 0] = planes[:HEIGHT], u, v
    return out


def mosaic(rgb, pattern):
    out = np.empty(rgb.shape[:2], rgb.dtype)
    for k, colour in enumerate(pattern):
        out[k // 2 :: 2, k % 2 :: 2] = rgb[k // 2 :: 2, k % 2 :: 2, "rgb".index(colour)]
    return out


def nv(rgb, swapped):
    planes = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    u, v = planes[HEIGHT:].reshape(2, -1)
    pair = np.stack([v, u] if swapped else [u, v], axis=1)
    return np.concatenate([planes[:HEIGHT].ravel(), pair.ravel()])


GREY = cv2.cvtColor(scene(), cv2.COLOR_RGB2GRAY)
WIDE = scene().astype(np.uint16)
ENCODINGS = {
    "rgb8": raw("rgb8", scene(), 192),
    "bgr8": raw("bgr8", scene()[..., ::-1], 192),
    "rgba8": raw("rgba8", np.dstack([scene(), GREY]), 256),
    "bgra8": raw("bgra8", np.dstack([scene()[..., ::-1], GREY]), 256),
    "rgb16": raw("rgb16", WIDE * 257, 384),
    "bgr16, 12 bits, big endian": raw("bgr16", (WIDE[..., ::-1] * 16).astype(">u2"), 384, big_endian=1),
    "uyvy": raw("uyvy", uyvy(scene()), 128),
    "yuv422": raw("yuv422", uyvy(scene()), 128),
    "yuv422_yuy2": raw("yuv422_yuy2", uyvy(scene())[..., ::-1], 128),
    "nv12": raw("nv12", nv(scene(), False), 64),
    "nv21": raw("nv21", nv(scene(), True), 64),
    "i420": raw("i420", cv2.cvtColor(scene(), cv2.COLOR_RGB2YUV_I420), 64),
    **{f"bayer_{p}8": raw(f"bayer_{p}8", mosaic(scene(), p), 64) for p in ("rggb", "bggr", "gbrg", "grbg")},
    **{
        f"bayer_{p}16": raw(f"bayer_{p}16", mosaic(WIDE * 4, p), 128)  # 10 bits
        for p in ("rggb", "bggr", "gbrg", "grbg")
    },
    "jpeg": compressed(jpeg(scene()), "rgb8; jpeg compressed bgr8"),
    "png": compressed(cv2.imencode(".png", scene()[..., ::-1])[1].ravel(), "jpeg"),  # decided by content
    "compressed bayer": compressed(cv2.imencode(".png", mosaic(scene(), "grbg"))[1].ravel(), "bayer_grbg8; png"),
}  # fmt: skip


@pytest.mark.parametrize("name", ENCODINGS)
def test_every_encoding_gives_the_colours_of_the_scene(tmp_path, name):
    _, images, _ = read(write(tmp_path / "bag", [ENCODINGS[name]] * 2))
    inner = np.abs(images[0] - scene().astype(int))[2:-2, 2:-2]
    assert len(images) == 2
    assert inner.mean() < 6.0  # subsampled chroma, demosaicing, JPEG
    assert images[0][2, 2, 2] > images[0][2, 2, 0]  # blue and red are not swapped


@pytest.mark.parametrize(
    ("fields", "level"),
    [
        (raw("mono8", GREY, 64), GREY),
        (raw("mono16", GREY.astype(np.uint16) * 257, 128), GREY),
        (raw("mono16", GREY.astype(np.uint16) * 16, 128), GREY),  # 12 bits
        (raw("mono16", (GREY.astype(np.uint16) * 257).astype("<u2"), 128, big_endian=1), GREY),
        (compressed(cv2.imencode(".jpg", GREY)[1].ravel(), "mono8; jpeg compressed mono8"), GREY),
    ],
)
def test_grey_images(tmp_path, fields, level):
    _, images, _ = read(write(tmp_path / "bag", [fields] * 2))
    assert np.abs(images[0][..., 1] - level.astype(int)).mean() < 3.0


@pytest.mark.parametrize("orientation", [3, 6])
def test_the_orientation_in_exif_data_is_ignored(tmp_path, orientation):
    """Case c06: K belongs to the pixels as they are stored."""
    data = compressed(with_exif(jpeg(scene()), orientation))
    _, images, problems = read(write(tmp_path / "bag", [data] * 2))
    assert np.abs(images[0] - scene().astype(int)).mean() < 3.0
    assert problems == []


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (raw("rgb8", scene(), 128), "2 messages repaired: step = 128"),  # case c09
        (raw("mono8", np.pad(GREY, ((0, 0), (0, 16))), 80), ""),
        (raw("mono8", np.pad(GREY, ((0, 0), (0, 16))), 64), ""),  # trailing bytes: each row has 64
    ],
)
def test_a_wrong_step_is_repaired_by_the_length_of_the_data(tmp_path, fields, words):
    _, images, problems = read(write(tmp_path / "bag", [fields] * 2))
    assert len(images) == 2
    if words:
        assert np.abs(images[0] - scene().astype(int)).max() == 0
        assert words in problems[0]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (raw("rgb8", scene()[:20], 192), "data = 3840 bytes: the image is truncated"),
        (raw("mono8", scene(), 192), "rows of 192 bytes have 3 bytes a pixel"),
        (compressed(jpeg(scene())[:-300]), "the JPEG is truncated"),
        (compressed(np.frombuffer(b"RIFF\0\0\0\0WEBPVP8 ", np.uint8), "webp"), "the image is WebP"),
    ],
)
def test_what_is_no_image_is_refused_by_field_and_value(tmp_path, fields, words):
    good = compressed(jpeg(scene())) if "format" in fields else raw("rgb8", scene(), 192)
    _, images, problems = read(write(tmp_path / "bag", [good, fields, good]))
    assert len(images) == 2
    assert "1 message refused" in problems[0]
    assert words in problems[0]


def test_a_camera_that_is_not_used_is_named(tmp_path):
    path = write(tmp_path / "bag", [raw("32FC1", np.zeros((HEIGHT, WIDTH), np.float32), 256)])
    problems = inspect(path, SourceOptions()).problems
    assert "/camera/image_raw is not used: encoding = '32FC1' is not that of a camera image" in problems
    with Bag(path) as bag, pytest.raises(UserError, match="is not used: encoding = '32FC1'"):
        BagSource(bag, SourceOptions(require=frozenset({"image"})))


CROP = scene()[12:42, 20:60]


@pytest.mark.parametrize(
    ("info", "image", "expected"),
    [
        # As the definition of CameraInfo says: size and K of the whole sensor.
        ({"roi": (20, 12, 40, 30)}, CROP, (50.0, 31.5 - 20, 23.5 - 12)),
        # Case c08: the size of the crop, K of the whole sensor.
        ({"roi": (20, 12, 40, 30), "size": (40, 30)}, CROP, (50.0, 31.5 - 20, 23.5 - 12)),
        # The driver has adapted K too.
        ({"roi": (20, 12, 40, 30), "size": (40, 30), "centre": (19.5, 14.5)}, CROP, (50.0, 19.5, 14.5)),
        ({"binning": (2, 2)}, cv2.resize(scene(), (32, 24)), (25.0, 15.5, 11.5)),
        ({"binning": (2, 2), "size": (32, 24), "centre": (15.5, 11.5)}, cv2.resize(scene(), (32, 24)),
         (50.0, 15.5, 11.5)),
        ({"roi": (20, 12, 40, 30), "binning": (2, 2)}, cv2.resize(CROP, (20, 15)), (25.0, 5.5, 5.5)),
        ({"roi": (0, 0, 64, 48)}, scene(), (50.0, 31.5, 23.5)),
    ],
)  # fmt: skip
def test_region_of_interest_and_binning(tmp_path, info, image, expected):
    rig, images, _ = read(write(tmp_path / "bag", [compressed(jpeg(image))] * 2, [info] * 2))
    camera = rig.camera
    assert (camera.fx_px, camera.cx_px, camera.cy_px) == pytest.approx(expected)
    assert (camera.width_px, camera.height_px) == (image.shape[1], image.shape[0])
    assert len(images) == 2


def test_a_region_of_interest_that_may_mean_both_is_refused(tmp_path):
    info = {"roi": (20, 16, 44, 32), "size": (44, 32), "centre": (31.5, 23.5)}
    path = write(tmp_path / "bag", [compressed(jpeg(scene()[16:48, 20:64]))], [info])
    text = inspect(path, SourceOptions()).error
    assert "roi.x_offset = 20" in text
    assert "rig file" in text


def test_k_of_zeros_in_the_first_messages_is_skipped(tmp_path):
    rig, images, problems = read(
        write(tmp_path / "bag", [compressed(jpeg(scene()))] * 4, [{"fx": 0.0}] * 2 + [{}] * 2)
    )
    assert rig.camera.fx_px == FX
    assert len(images) == 4
    assert "2 messages repaired: k = 0" in problems[0]


@pytest.mark.parametrize(
    ("model", "D", "expected"),
    [
        ("plumb_bob", [0.1, 0.01, 0.0, 0.0], ("plumb_bob", 5)),
        ("plumb_bob", [0.1, 0.01, 0.0, 0.0, 0.0, 0.001, 0.0, 0.0], ("rational_polynomial", 8)),
        ("rational_polynomial", [0.1, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0], ("rational_polynomial", 8)),
        ("rational_polynomial", [0.01] * 8 + [0.001] * 4 + [0.0, 0.0], ("rational_polynomial", 12)),
        ("equidistant", [0.01, 0.0, 0.0, 0.0], ("equidistant", 4)),
        ("fisheye", [0.01, 0.0, 0.0, 0.0], ("equidistant", 4)),
        ("plumb_bob", [], ("none", 0)),
        ("", [0.0] * 5, ("none", 0)),
    ],
)
def test_distortion_of_any_length(tmp_path, model, D, expected):
    rig, _, _ = read(write(tmp_path / "bag", [compressed(jpeg(scene()))], [{"distortion": (model, D)}]))
    assert (rig.camera.distortion_model, len(rig.camera.distortion)) == expected


def test_rectified_images_have_p_and_no_distortion(tmp_path):
    info = {"distortion": ("plumb_bob", [-0.3, 0.1, 0.0, 0.0, 0.0]), "p_fx": 45.0}
    images = [compressed(jpeg(scene()))]
    rig, _, _ = read(write(tmp_path / "rect", images, [info], topic="/camera/image_rect"))
    assert (rig.camera.fx_px, rig.camera.distortion_model) == (45.0, "none")
    rig, _, _ = read(write(tmp_path / "raw", images, [info], topic="/camera/direct_raw"))
    assert (rig.camera.fx_px, rig.camera.distortion_model) == (50.0, "plumb_bob")
    assert is_rectified("/cam/rect/image")
    assert not is_rectified("/correction/image_raw")


@pytest.mark.parametrize(
    ("info", "words"),
    [
        ({"fx": 100.0, "p_fx": 50.0}, "fx is 100.0 px in K and 50.0 px in P"),
        ({"centre": (15.5, 11.5)}, "the principal point (15.5, 11.5) px is far from the middle"),
        ({"distortion": ("plumb_bob", [-5.0, 0.0, 0.0, 0.0, 0.0])}, "cannot be inverted"),
    ],
)
def test_values_that_contradict_each_other_are_said(tmp_path, info, words):
    _, _, problems = read(write(tmp_path / "bag", [compressed(jpeg(scene()))] * 2, [info] * 2))
    assert any(words in problem for problem in problems)


def test_a_size_that_changes_is_followed_by_its_camera_info(tmp_path):
    """Case c15. Images of the new size without their CameraInfo are refused and counted."""
    small = compressed(jpeg(cv2.resize(scene(), (32, 24), interpolation=cv2.INTER_AREA)))
    half = {"size": (32, 24), "fx": 25.0, "centre": (15.5, 11.5)}
    images = [compressed(jpeg(scene()))] * 2 + [small] * 4
    _, read_images, problems = read(write(tmp_path / "bag", images, [{}] * 2 + [half] * 4))
    assert len(read_images) == 6
    assert np.abs(read_images[5] - scene().astype(int))[2:-2, 2:-2].mean() < 4.0
    assert "4 messages repaired: width, height = 32x24" in problems[0]
    _, read_images, problems = read(write(tmp_path / "bag2", images))
    assert len(read_images) == 2
    assert (
        "4 messages refused: width, height = 32x24: the calibration is for images of 64x48 px" in problems[0]
    )
