"""Each field of CameraInfo and Image is mutated: what replay refuses `info` names, and nothing goes wrong silently."""

import cv2
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.recording.camera_info import read_camera_info
from beamsplat.common.recording.image_reading import ImageReading
from beamsplat.common.recording.input_report import InputFault, InputReport
from beamsplat.services.replay.inspection import inspect
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source
from tests.services.replay.make_bags import KINDS, Drive, write_bag
from tests.services.replay.test_cases_images import HEIGHT, WIDTH, raw, scene

CLEAN_K = (50.0, 50.0, 31.5, 23.5)
LENGTH = 3 * WIDTH * HEIGHT


class Fields:
    """A message with these fields."""

    def __init__(self, **fields):
        self.__dict__.update(fields)


def info(**changed):
    K = np.array([50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1])
    P = np.array([50.0, 0, 31.5, 0, 0, 50.0, 23.5, 0, 0, 0, 1, 0])
    roi = Fields(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {"width": WIDTH, "height": HEIGHT, "k": K, "d": np.zeros(5), "p": P, "r": np.eye(3).ravel(),
              "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": roi}  # fmt: skip
    return Fields(**{**fields, **changed})


def array(name, index, value):
    changed = np.array(getattr(info(), name))
    changed[index % len(changed)] = value
    return {name: changed}


NUMBER = st.one_of(st.sampled_from([0.0, -1.0, np.nan, np.inf, 1e9]), st.floats(-500.0, 500.0))
MUTATED_INFO = st.one_of(
    st.builds(array, st.sampled_from(["k", "p", "d"]), st.integers(0, 11), NUMBER),
    st.fixed_dictionaries({"width": st.integers(0, 200)}),
    st.fixed_dictionaries({"height": st.integers(0, 200)}),
    st.fixed_dictionaries({"binning_x": st.integers(0, 5)}),
    st.fixed_dictionaries({"binning_y": st.integers(0, 5)}),
    st.fixed_dictionaries({"distortion_model": st.sampled_from(["", "none", "fisheye", "unified", "Plumb_Bob", "?" * 99])}),
    st.builds(
        lambda x, y, w, h: {"roi": Fields(x_offset=x, y_offset=y, width=w, height=h, do_rectify=False)},
        st.integers(0, 80), st.integers(0, 80), st.integers(0, 80), st.integers(0, 80),
    ),
)  # fmt: skip


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(MUTATED_INFO)
def test_a_mutated_camera_info_is_used_rightly_or_said(changed):
    """K within 3 % and 3 px of the clean one gives depth within 3x of its error; else there is a sentence."""
    try:
        read = read_camera_info(info(**changed), (WIDTH, HEIGHT), "/camera/image_raw", "bag")
    except UserError as refusal:  # names the bag, the field and the value
        said = str(refusal)
        read = None
    else:
        said = ""
    assert read is not None or not said or said.startswith("bag: ")
    if read is None:
        return  # "never calibrated" is said by the caller
    K = [read.fields[name] for name in ("fx_px", "fy_px", "cx_px", "cy_px")]
    wrong = (
        max(abs(K[0] / 50.0 - 1), abs(K[1] / 50.0 - 1)) > 0.03
        or max(abs(K[2] - 31.5), abs(K[3] - 23.5)) > 3.0
    )
    assert read.doubts or read.notes or not wrong
    D = np.array(read.fields["distortion"])
    if len(D) and not read.doubts:  # OpenCV finds the ray of each corner, at most a third nearer to the axis
        camera = np.array([[K[0], 0.0, K[2]], [0.0, K[1], K[3]], [0.0, 0.0, 1.0]])
        corners = np.array([[[x, y]] for x in (0.0, WIDTH - 1.0) for y in (0.0, HEIGHT - 1.0)])
        until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-9)
        rays = cv2.undistortPoints(corners, camera, D, criteria=until)[:, 0]
        lengths = np.linalg.norm(rays, axis=1)
        straight = np.linalg.norm((corners[:, 0] - K[2:]) / K[:2], axis=1)
        assert (lengths > 0.65 * straight).all()
        back, _ = cv2.projectPoints(np.column_stack([rays, np.ones(4)]), np.zeros(3), np.zeros(3), camera, D)
        assert np.abs(back - corners).max() < 0.5


MUTATED_IMAGE = st.one_of(
    st.fixed_dictionaries({"width": st.integers(0, 200)}),
    st.fixed_dictionaries({"height": st.integers(0, 200)}),
    st.fixed_dictionaries({"step": st.integers(0, 1000)}),
    st.fixed_dictionaries({"encoding": st.sampled_from(
        ["rgba8", "mono8", "mono16", "bayer_rggb8", "nv12", "uyvy", "yuv422_yuy2", "32FC1", "", "what"])}),
    st.fixed_dictionaries({"is_bigendian": st.integers(0, 1)}),
    st.builds(lambda n: {"data": scene().ravel()[:n]}, st.integers(0, LENGTH)),
)  # fmt: skip


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(MUTATED_IMAGE)
def test_a_mutated_image_is_read_rightly_or_refused(changed):
    reading = ImageReading(InputReport(), "/camera/image_raw")
    reading.calibrate({"width_px": WIDTH, "height_px": HEIGHT}, follow=False)
    try:
        fields = reading.read(Fields(**{**raw("rgb8", scene(), 3 * WIDTH), **changed}))
    except InputFault:  # has a field, a value and a reason
        return
    decoded = decode_rgb(
        fields["data"], fields["encoding"], fields["width_px"], fields["height_px"], fields["step_bytes"]
    )
    assert np.abs(decoded.astype(int) - scene()).mean() < 1.0 or reading.report.findings


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    st.sampled_from(KINDS), st.integers(0, 2**32 - 1), st.sampled_from(["flip", "cut", "zero"]),
    st.floats(0.02, 0.98),
)  # fmt: skip
def test_info_never_approves_what_replay_refuses(tmp_path_factory, kind, seed, how, where):
    """Bytes of a bag are changed, cut off or set to zero: both refuse it, or both tell the same problems."""
    path = write_bag(tmp_path_factory.mktemp("bag"), kind, Drive(seconds=1.5))
    file = path if kind == "ros1" else next(f for f in path.iterdir() if f.suffix != ".yaml")
    data = bytearray(file.read_bytes())
    at = int(where * len(data))
    if how == "cut":
        del data[at:]
    else:
        rng = np.random.default_rng(seed)
        data[at : at + 64] = (
            bytes(64) if how == "zero" else rng.integers(0, 256, 64, dtype=np.uint8).tobytes()
        )
    file.write_bytes(data)
    try:
        source = open_source(path, SourceOptions())
        try:
            source.rig()
            for _ in source.messages():
                pass
            refused, problems = "", source.problems
        finally:
            source.close()
    except ValueError as error:
        refused, problems = str(error), []
    try:
        report = inspect(path, SourceOptions())
        error, said = report.error, report.problems
    except ValueError as caught:
        error, said = str(caught), []
    assert bool(error) or not refused, f"replay refuses it, info does not: {refused}"
    assert error or set(problems) <= set(said)


def test_a_grey_jpeg_is_an_image():
    reading = ImageReading(InputReport(), "/camera/image_raw")
    grey = cv2.imencode(".jpg", scene()[..., 0])[1].ravel()
    fields = reading.read(Fields(format="mono8; jpeg compressed mono8", data=grey))
    assert (fields["encoding"], fields["width_px"], fields["height_px"]) == ("jpeg", WIDTH, HEIGHT)
