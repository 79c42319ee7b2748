"""`beamsplat setup`: find the connected sensors, calibrate them, write a deployment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import writable

if TYPE_CHECKING:
    import numpy as np

    from beamsplat.common.geometry.rig import CameraSection
    from beamsplat.common.messages import Image
    from beamsplat.tools.setup.board_calibration import LidarBoardCalibration
    from beamsplat.tools.setup.chessboard import Chessboard
    from beamsplat.tools.setup.discovery import FoundSensor
    from beamsplat.tools.setup.files import MeasuredMount
    from beamsplat.tools.setup.intrinsics import CameraIntrinsics, IntrinsicsCalibration

console = Console(soft_wrap=True, highlight=False)
_VIEWS_TIMEOUT_S = 180.0  # to collect views of the board
_COLUMNS = 64


def setup(
    out: Annotated[Path, typer.Option(callback=writable, help="Deployment to write")] = Path("robot.toml"),
    rig: Annotated[Path, typer.Option(help="Rig file to write, or to keep if it exists")] = Path("rig.toml"),
    camera: Annotated[
        list[str] | None,
        typer.Option(help="Camera to try in addition to /dev/video*: rtsp:// or http:// address"),
    ] = None,
    device: Annotated[
        list[str] | None,
        typer.Option(help="Lidar device to try in addition: /dev/ttyAMA0, tcp/192.168.0.10:10940"),
    ] = None,
    robot: Annotated[str, typer.Option(help="Name of the robot")] = "robot1",
    overwrite: Annotated[bool, typer.Option(help="Replace an existing deployment")] = False,
) -> None:
    """Find camera and lidar, show their data, calibrate them, write robot.toml and rig.toml.

    Examples:

        beamsplat setup

        beamsplat setup --device tcp/192.168.0.10:10940 --camera rtsp://192.168.0.20/stream
    """
    from beamsplat.common.files.persist import write_atomically
    from beamsplat.tools.setup.files import robot_text

    if out.exists() and not overwrite:
        raise UserError(f"{out} exists already: choose another name with --out, or use --overwrite")
    found_camera, found_lidar = _find_camera(camera or []), _find_lidar(device or [])
    if found_lidar is None:
        raise UserError(
            "no lidar answers, but localization needs one. `beamsplat doctor` lists the connected devices"
        )
    upside_down = typer.confirm("Is the lidar mounted upside down?", default=False)
    lidar_options = {**found_lidar.options, **({"upside_down": True} if upside_down else {})}
    if rig.exists() and typer.confirm(f"{rig} exists already: keep it?", default=True):
        _check_existing_rig(rig, found_camera)
    else:
        write_atomically(rig, _ask_calibration(found_camera, lidar_options, out.parent).encode())
        console.print(f"[green]written:[/] {rig}")
    camera_options = found_camera.options if found_camera is not None else None
    write_atomically(out, robot_text(robot, str(rig), camera_options, lidar_options).encode())
    console.print(f"[green]written:[/] {out}")
    _verify(out)
    console.print(f"Next: run `beamsplat run {out}`, and open http://127.0.0.1:8420")


def _verify(out: Path) -> None:
    from beamsplat.common.config.deployment import load_deployment
    from beamsplat.tools.system.assembly import faults

    fatal = [fault.text for fault in faults(load_deployment(out)) if fault.fatal]
    if fatal:
        raise UserError(f"{out}: {'; '.join(fatal)}")
    console.print(f"{out} fits together (`beamsplat check {out}`)")


# --- sensors ---


def _print(text: str) -> None:
    console.print(text, markup=False)


def _find_camera(more: list[str]) -> FoundSensor | None:
    from beamsplat.tools.setup.discovery import camera_devices, find_camera, probe_all

    console.rule("Camera", align="left")
    answers = probe_all((*more, *camera_devices()), find_camera, _print)
    chosen = _choose("camera", answers, [str(a.options["source"]) for a in answers])
    if chosen is None:
        console.print("No camera: the robot localizes with its lidar only, and no 3D map is made.")
        return None
    _show_image(_first_image(chosen))
    return chosen


def _find_lidar(more: list[str]) -> FoundSensor | None:
    from beamsplat.tools.setup.discovery import find_lidar, lidar_devices, probe_all

    console.rule("Lidar", align="left")
    answers = probe_all((*more, *lidar_devices()), find_lidar, _print)
    chosen = _choose("lidar", answers, [f"{a.options['kind']} at {a.options['device']}" for a in answers])
    if chosen is not None:
        _show_scan(chosen.first)
    return chosen


def _choose(what: str, answers: list[FoundSensor], names: list[str]) -> FoundSensor | None:
    if len(answers) < 2:
        return answers[0] if answers else None
    for number, name in enumerate(names, start=1):
        console.print(f"  {number}) {name}", markup=False)
    chosen = _prompt_number(f"Which {what}?", 1, 1, len(answers), int)
    return answers[int(chosen) - 1]


def _prompt_number(text: str, default: float, low: float, high: float, kind: type[float] = float) -> float:
    """Ask for a number from `low` to `high`; ask again after any other answer."""

    def parse(answer: str) -> float:
        try:
            value = kind(answer)
        except ValueError as error:
            raise typer.BadParameter(f"{answer!r} is not a number") from error
        if not low <= value <= high:
            raise typer.BadParameter(f"{value:g} is not in the range {low:g} to {high:g}")
        return value

    return typer.prompt(text, default=default, value_proc=parse)


def _first_image(camera: FoundSensor) -> Image:
    from beamsplat.common.messages import Image

    assert isinstance(camera.first, Image)  # as `find_camera` asks for
    return camera.first


def _show_image(image: Image) -> None:
    from beamsplat.tools.setup.terminal import image_text

    console.print(image_text(_decoded(image)[..., ::-1], min(_COLUMNS, console.width)), soft_wrap=False)
    console.print(f"{image.width_px}x{image.height_px} pixels")


def _show_scan(scan: Any) -> None:
    import numpy as np

    from beamsplat.tools.setup.terminal import scan_text

    angle = scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(scan.ranges_m))
    seen = np.isfinite(scan.ranges_m)
    points = (scan.ranges_m * np.stack([np.cos(angle), np.sin(angle)]))[:, seen].T
    console.print(scan_text(points, min(_COLUMNS, console.width - 1)), soft_wrap=False)
    console.print(f"{seen.sum()} of {len(seen)} beams; objects in front of the robot should be at the top")


def _decoded(image: Image) -> np.ndarray:
    from beamsplat.common.messages.image_codec import decode_rgb

    return decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)


def _grey(image: Image) -> np.ndarray:
    import cv2

    return cv2.cvtColor(_decoded(image), cv2.COLOR_RGB2GRAY)


# --- calibration ---


def _check_existing_rig(rig: Path, camera: FoundSensor | None) -> None:
    """Check that an existing rig file fits the connected camera.

    Raises:
        UserError: the rig file has no camera, or the image size differs.
    """
    from beamsplat.common.geometry.rig import load_rig

    loaded = load_rig(rig)
    if camera is None:
        return
    image = _first_image(camera)
    size_px = image.width_px, image.height_px
    if loaded.camera is None:
        raise UserError(f"{rig}: [camera] is missing, but a camera was found: do not keep the file")
    if (loaded.camera.width_px, loaded.camera.height_px) != size_px:
        raise UserError(
            f"{rig}: K is for {loaded.camera.width_px}x{loaded.camera.height_px} pixels, the camera delivers "
            f"{size_px[0]}x{size_px[1]}: do not keep the file"
        )


def _ask_calibration(camera: FoundSensor | None, lidar: dict[str, Any], folder: Path) -> str:
    """Ask the user for mounts, calibrate camera and lidar; return the text of rig.toml.

    `folder` receives the chessboard to print.
    """
    from beamsplat.tools.setup.files import MeasuredMount, camera_section, rig_text

    console.rule("Mounts", align="left")
    console.print("Measured from the point on the floor between the wheels, in metres and degrees.")
    if camera is None:
        return rig_text(
            None, _ask_mount("lidar", MeasuredMount(0.0, 0.0, 0.18), turns=True).T_body_lidar(), (), ""
        )
    T_body_camera = _ask_mount("camera", MeasuredMount(0.10, 0.0, 0.30), turns=False).T_body_camera()
    T_body_lidar = _ask_mount("lidar", MeasuredMount(0.0, 0.0, 0.18), turns=True).T_body_lidar()
    console.rule("Camera intrinsics", align="left")
    seen = _calibrate_with_chessboard(camera, folder)
    if seen is None:
        file, note = _intrinsics_from_field_of_view(camera, T_body_camera)
        return rig_text(file, T_body_lidar, (note,), f"MEASURE with a chessboard: {note}.")
    lens, board = seen
    file = camera_section(lens, T_body_camera)
    note = f"With a chessboard: reprojection error {lens.rms_px:.3f} px over {lens.views} views."
    return rig_text(file, _calibrate_lidar_extrinsics(camera, lidar, file, board, T_body_lidar), (), note)


def _ask_mount(what: str, default: MeasuredMount, *, turns: bool) -> MeasuredMount:
    from beamsplat.tools.setup.files import MeasuredMount

    def ask(word: str, default: float) -> float:
        return typer.prompt(f"{what}: {word}", default=default, type=float)

    forward, left = ask("forward (m)", default.forward_m), ask("left (m)", default.left_m)
    up = ask("up (m)", default.up_m)
    if turns:
        return MeasuredMount(forward, left, up, left_deg=ask("turned to the left (degrees)", 0.0))
    return MeasuredMount(forward, left, up, down_deg=ask("looks down by (degrees)", 0.0))


def _intrinsics_from_field_of_view(
    camera: FoundSensor, T_body_camera: np.ndarray
) -> tuple[CameraSection, str]:
    """Ask for the field of view; return section [camera] of rig.toml and a note on how K was determined."""
    from beamsplat.common.geometry.rig import CameraSection, Mount
    from beamsplat.services.replay.rig_draft import pinhole_from_fov

    fov_deg = _prompt_number("Horizontal field of view (degrees)", 65.0, 10.0, 170.0)
    image = _first_image(camera)
    size_px = image.width_px, image.height_px
    note = f"fx, fy from a horizontal field of view of {fov_deg:g} degrees as stated, no distortion"
    return CameraSection(**pinhole_from_fov(*size_px, fov_deg), mount=Mount.of(T_body_camera)), note


def _calibrate_with_chessboard(
    camera: FoundSensor, folder: Path
) -> tuple[CameraIntrinsics, Chessboard] | None:
    """Return the intrinsics from a printed chessboard, and the board; None if the user declines."""
    from beamsplat.tools.setup.chessboard import DEFAULT_CHESSBOARD, chessboard_pdf

    while typer.confirm(
        "Calibrate with a printed chessboard? (otherwise: by its field of view)", default=True
    ):
        path = folder / "chessboard.pdf"
        path.write_bytes(chessboard_pdf())
        console.print(f"[green]written:[/] {path}: print it at 100 %, glue it on a flat plate.")
        board = DEFAULT_CHESSBOARD._replace(square_m=_ask_square_m(DEFAULT_CHESSBOARD.square_m))
        _wait_for_enter("Hold it in front of the camera: near, far, tilted, in all corners of the image")
        views = _take_views(camera.options, board)
        try:
            lens = views.solve()
        except ValueError as error:
            console.print(f"[yellow]{error}[/]")
            continue
        console.print(
            f"reprojection error {lens.rms_px:.2f} px over {lens.views} views; "
            f"fx {lens.K[0, 0]:.1f}, fy {lens.K[1, 1]:.1f} px, +- {lens.focal_sigma_px:.1f}"
        )
        if lens.is_good:
            return lens, board
        console.print(
            "[yellow]The result is not accurate enough:[/] keep the board flat, tilt it, fill the image."
        )
    return None


def _take_views(camera: dict[str, Any], board: Chessboard) -> IntrinsicsCalibration:
    import time

    from beamsplat.common.messages import Image
    from beamsplat.tools.setup.discovery import sensor_messages
    from beamsplat.tools.setup.intrinsics import VIEWS, IntrinsicsCalibration

    views = IntrinsicsCalibration(board)
    deadline = time.monotonic() + _VIEWS_TIMEOUT_S
    with sensor_messages("camera", camera, Image) as stream:
        for image, _ in stream:
            if isinstance(image, Image) and views.add(_grey(image)) == "taken":
                missing = views.missing()
                console.print(
                    f"view {len(views.views)} of {VIEWS}{f'; missing: {missing}' if missing else ''}"
                )
            if len(views.views) >= VIEWS or time.monotonic() > deadline:
                return views
    return views


def _ask_square_m(square_m: float) -> float:
    return typer.prompt("Side of a square on the print (mm)", default=square_m * 1e3, type=float) / 1e3


def _wait_for_enter(text: str) -> None:
    typer.prompt(f"{text}. Enter", default="", show_default=False)


def _calibrate_lidar_extrinsics(
    camera: FoundSensor,
    lidar: dict[str, Any],
    lens: CameraSection,
    board: Chessboard,
    T_body_lidar: np.ndarray,
) -> np.ndarray:
    """Return `T_body_lidar` [4, 4], calibrated with chessboards, or unchanged if the user declines."""
    from beamsplat.tools.setup.board_calibration import N_BOARDS, LidarBoardCalibration

    console.rule("Lidar against camera", align="left")
    console.print(
        "The lidar's beams must cross the chessboard: at 0.5 to 1.5 m, turned to the left and to the right."
    )
    while typer.confirm(f"Do that now, {N_BOARDS} times? (otherwise: as measured)", default=True):
        boards = LidarBoardCalibration(lens.model(), board)
        _take_pairs(camera.options, lidar, boards, N_BOARDS)
        try:
            found = boards.solve(T_body_lidar)
        except ValueError as error:
            console.print(f"[yellow]{error}[/]")
            continue
        console.print(found.summary)
        if found.is_good:
            return found.T_body_lidar
        console.print("[yellow]The result is not accurate enough.[/]")
    console.print(
        "The lidar's mount stays as measured; `beamsplat calibrate extrinsics` estimates it from a recording."
    )
    return T_body_lidar


def _take_pairs(
    camera: dict[str, Any], lidar: dict[str, Any], boards: LidarBoardCalibration, wanted: int
) -> None:
    from beamsplat.common.messages import Image, Scan
    from beamsplat.tools.setup.discovery import SensorStream

    with SensorStream("camera", camera, Image) as images, SensorStream("lidar", lidar, Scan) as scans:
        while boards.count < wanted:
            _wait_for_enter(f"board {boards.count + 1} of {wanted}: hold it still")
            before, scan, after = _grey(images.next()), scans.next(), _grey(images.next())
            console.print(boards.add(before, scan, after))
