"""`beamsplat setup`: from what is plugged in to a deployment that runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from beamsplat.common.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from beamsplat.common.geometry.rig import CameraSection
    from beamsplat.common.messages import Image
    from beamsplat.tools.setup.board_calibration import Boards
    from beamsplat.tools.setup.discovery import Found
    from beamsplat.tools.setup.files import Place
    from beamsplat.tools.setup.lens import Lens, LensCalibration
    from beamsplat.tools.setup.pattern import Board

console = Console(soft_wrap=True, highlight=False)
_LOOK_S = 180.0  # for views of the board
_COLUMNS = 64


def setup(
    out: Annotated[Path, typer.Option(help="Deployment to write")] = Path("robot.toml"),
    rig: Annotated[Path, typer.Option(help="Calibration to write, or to keep if it is there")] = Path(
        "rig.toml"
    ),
    camera: Annotated[
        list[str] | None, typer.Option(help="Camera to try besides /dev/video*: rtsp:// or http:// address")
    ] = None,
    device: Annotated[
        list[str] | None,
        typer.Option(help="Where else a lidar may be: /dev/ttyAMA0, tcp/192.168.0.10:10940"),
    ] = None,
    robot: Annotated[str, typer.Option(help="Name of the robot")] = "robot1",
    overwrite: Annotated[bool, typer.Option(help="Replace an existing deployment")] = False,
) -> None:
    """Finds camera and lidar, shows what they see, calibrates them, writes robot.toml and rig.toml.

    Examples:

        beamsplat setup

        beamsplat setup --device tcp/192.168.0.10:10940 --camera rtsp://192.168.0.20/stream
    """
    from beamsplat.common.files.persist import write_atomically
    from beamsplat.tools.setup.files import robot_text

    if out.exists() and not overwrite:
        raise UserError(f"{out}: exists already; choose another name with --out, or say --overwrite")
    found_camera, found_lidar = _find_camera(camera or []), _find_lidar(device or [])
    if found_lidar is None:
        raise UserError(
            "no lidar answers: nothing to localize with. `beamsplat doctor` says what is plugged in"
        )
    upside_down = typer.confirm("Is the lidar mounted head down?", default=False)
    lidar_options = {**found_lidar.options, **({"upside_down": True} if upside_down else {})}
    if rig.exists() and typer.confirm(f"{rig} is there already: keep it?", default=True):
        _check_kept(rig, found_camera)
    else:
        write_atomically(rig, _calibrated(found_camera, lidar_options, out.parent).encode())
        console.print(f"[green]written:[/] {rig}")
    camera_options = found_camera.options if found_camera is not None else None
    write_atomically(out, robot_text(robot, str(rig), camera_options, lidar_options).encode())
    console.print(f"[green]written:[/] {out}")
    _verify(out)
    console.print(f"Next: beamsplat run {out}, and open http://127.0.0.1:8420")


def _verify(out: Path) -> None:
    from beamsplat.common.config.deployment import load_deployment
    from beamsplat.tools.system.assembly import faults

    fatal = [fault.text for fault in faults(load_deployment(out)) if fault.fatal]
    if fatal:
        raise UserError(f"{out}: {'; '.join(fatal)}")
    console.print(f"{out} fits together (`beamsplat check {out}`)")


# --- what is there ---


def _say(text: str) -> None:
    console.print(text, markup=False)


def _find_camera(more: list[str]) -> Found | None:
    from beamsplat.tools.setup.discovery import answers_of, camera_places, find_camera

    console.rule("Camera", align="left")
    answers = answers_of((*more, *camera_places()), find_camera, _say)
    chosen = _choose("camera", answers, [str(a.options["source"]) for a in answers])
    if chosen is None:
        console.print("No camera: the robot will be localized by its lidar alone, and no map is painted.")
        return None
    _show_picture(chosen.first)
    return chosen


def _find_lidar(more: list[str]) -> Found | None:
    from beamsplat.tools.setup.discovery import answers_of, find_lidar, lidar_places

    console.rule("Lidar", align="left")
    answers = answers_of((*more, *lidar_places()), find_lidar, _say)
    chosen = _choose("lidar", answers, [f"{a.options['kind']} at {a.options['device']}" for a in answers])
    if chosen is not None:
        _show_scan(chosen.first)
    return chosen


def _choose(what: str, answers: list[Found], names: list[str]) -> Found | None:
    if len(answers) < 2:
        return answers[0] if answers else None
    for number, name in enumerate(names, start=1):
        console.print(f"  {number}) {name}", markup=False)
    number = typer.prompt(f"Which {what}?", default=1, type=typer.IntRange(1, len(answers)))
    return answers[number - 1]


def _show_picture(image: Image) -> None:
    from beamsplat.tools.setup.terminal import picture_text

    console.print(picture_text(_decoded(image)[..., ::-1], min(_COLUMNS, console.width)), soft_wrap=False)
    console.print(f"{image.width_px}x{image.height_px} pixels")


def _show_scan(scan: Any) -> None:
    import numpy as np

    from beamsplat.tools.setup.terminal import scan_text

    angle = scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(scan.ranges_m))
    seen = np.isfinite(scan.ranges_m)
    points = (scan.ranges_m * np.stack([np.cos(angle), np.sin(angle)]))[:, seen].T
    console.print(scan_text(points, min(_COLUMNS, console.width - 1)), soft_wrap=False)
    console.print(f"{seen.sum()} of {len(seen)} beams; what is ahead of the robot should be up here")


def _decoded(image: Image) -> np.ndarray:
    from beamsplat.common.messages.image_codec import decode_rgb

    return decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)


def _grey(image: Image) -> np.ndarray:
    import cv2

    return cv2.cvtColor(_decoded(image), cv2.COLOR_RGB2GRAY)


# --- calibration ---


def _check_kept(rig: Path, camera: Found | None) -> None:
    """A kept calibration must be this camera's."""
    from beamsplat.common.geometry.rig import load_rig

    loaded = load_rig(rig)
    if camera is None:
        return
    size_px = camera.first.width_px, camera.first.height_px
    if loaded.camera is None:
        raise UserError(f"{rig}: has no [camera], but there is one: do not keep it")
    if (loaded.camera.width_px, loaded.camera.height_px) != size_px:
        raise UserError(
            f"{rig}: K is for {loaded.camera.width_px}x{loaded.camera.height_px} pixels, the camera gives "
            f"{size_px[0]}x{size_px[1]}: do not keep it"
        )


def _calibrated(camera: Found | None, lidar: dict[str, Any], folder: Path) -> str:
    """Text of rig.toml, asked for step by step."""
    from beamsplat.tools.setup.files import Place, camera_file, rig_text

    console.rule("Where they sit", align="left")
    console.print("From the point on the floor between the wheels, in metres and degrees.")
    if camera is None:
        return rig_text(None, _ask_place("lidar", Place(0.0, 0.0, 0.18), turns=True).lidar(), (), "")
    T_body_camera = _ask_place("camera", Place(0.10, 0.0, 0.30), turns=False).camera()
    T_body_lidar = _ask_place("lidar", Place(0.0, 0.0, 0.18), turns=True).lidar()
    console.rule("How the camera sees", align="left")
    seen = _look_at_board(camera, folder)
    if seen is None:
        file, note = _by_field_of_view(camera, T_body_camera)
        return rig_text(file, T_body_lidar, (note,), f"MEASURE with a chessboard: {note}.")
    lens, board = seen
    file = camera_file(lens, T_body_camera)
    note = f"With a chessboard: reprojection error {lens.rms_px:.3f} px over {lens.views} views."
    return rig_text(file, _against_camera(camera, lidar, file, board, T_body_lidar), (), note)


def _ask_place(what: str, usual: Place, *, turns: bool) -> Place:
    from beamsplat.tools.setup.files import Place

    def ask(word: str, default: float) -> float:
        return typer.prompt(f"{what}: {word}", default=default, type=float)

    forward, left = ask("forward (m)", usual.forward_m), ask("left (m)", usual.left_m)
    up = ask("up (m)", usual.up_m)
    if turns:
        return Place(forward, left, up, left_deg=ask("turned to the left (degrees)", 0.0))
    return Place(forward, left, up, down_deg=ask("looks down by (degrees)", 0.0))


def _by_field_of_view(camera: Found, T_body_camera: np.ndarray) -> tuple[CameraSection, str]:
    """[camera] of the rig, and one sentence on where it comes from."""
    from beamsplat.common.geometry.rig import CameraSection, Mount
    from beamsplat.services.replay.rig_draft import pinhole

    fov_deg = typer.prompt("Horizontal field of view (degrees)", default=65.0, type=typer.FloatRange(10, 170))
    size_px = camera.first.width_px, camera.first.height_px
    note = f"fx, fy from a horizontal field of view of {fov_deg:g} degrees as stated, no distortion"
    return CameraSection(**pinhole(*size_px, fov_deg), mount=Mount.of(T_body_camera)), note


def _look_at_board(camera: Found, folder: Path) -> tuple[Lens, Board] | None:
    """The lens by a printed chessboard, and the board; None where that is not wanted."""
    from beamsplat.tools.setup.pattern import BOARD, board_pdf

    while typer.confirm("Calibrate with a printed chessboard? (else: by its field of view)", default=True):
        path = folder / "chessboard.pdf"
        path.write_bytes(board_pdf())
        console.print(f"[green]written:[/] {path}: print it at 100 %, glue it on something flat.")
        board = BOARD._replace(square_m=_ask_square_m(BOARD.square_m))
        _wait_for_enter("Hold it before the camera: near, far, tilted, in all corners")
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
        if lens.good:
            return lens, board
        console.print("[yellow]That is not good enough:[/] keep the board flat, tilt it, fill the picture.")
    return None


def _take_views(camera: dict[str, Any], board: Board) -> LensCalibration:
    import time

    from beamsplat.common.messages import Image
    from beamsplat.tools.setup.discovery import messages
    from beamsplat.tools.setup.lens import VIEWS, LensCalibration

    views = LensCalibration(board)
    deadline = time.monotonic() + _LOOK_S
    with messages("camera", camera, Image) as stream:
        for image, _ in stream:
            if image is not None and views.add(_grey(image)) == "taken":
                missing = views.missing()
                console.print(
                    f"view {len(views.views)} of {VIEWS}{f'; not yet: {missing}' if missing else ''}"
                )
            if len(views.views) >= VIEWS or time.monotonic() > deadline:
                return views
    return views


def _ask_square_m(square_m: float) -> float:
    return typer.prompt("Side of a square on the print (mm)", default=square_m * 1e3, type=float) / 1e3


def _wait_for_enter(text: str) -> None:
    typer.prompt(f"{text}. Enter", default="", show_default=False)


def _against_camera(
    camera: Found, lidar: dict[str, Any], lens: CameraSection, board: Board, T_body_lidar: np.ndarray
) -> np.ndarray:
    """`T_body_lidar` as beams on the board tell it, or as it was measured."""
    from beamsplat.tools.setup.board_calibration import N_BOARDS, Boards

    console.rule("Lidar against camera", align="left")
    console.print(
        "The beams must cross the chessboard: at 0.5 to 1.5 m, turned to the left and to the right."
    )
    while typer.confirm(f"Do that now, {N_BOARDS} times? (else: as measured)", default=True):
        boards = Boards(lens.model(), board)
        _take_pairs(camera.options, lidar, boards, N_BOARDS)
        try:
            found = boards.solve(T_body_lidar)
        except ValueError as error:
            console.print(f"[yellow]{error}[/]")
            continue
        console.print(found.sentence)
        if found.good:
            return found.T_body_lidar
        console.print("[yellow]That is not good enough.[/]")
    console.print("The lidar stays as measured; `beamsplat calibrate extrinsics` finds it from a drive, too.")
    return T_body_lidar


def _take_pairs(camera: dict[str, Any], lidar: dict[str, Any], boards: Boards, wanted: int) -> None:
    from beamsplat.common.messages import Image, Scan
    from beamsplat.tools.setup.discovery import Watched

    with Watched("camera", camera, Image) as pictures, Watched("lidar", lidar, Scan) as scans:
        while boards.count < wanted:
            _wait_for_enter(f"board {boards.count + 1} of {wanted}: hold it still")
            before, scan, after = _grey(pictures.next()), scans.next(), _grey(pictures.next())
            console.print(boards.add(before, scan, after))
