"""Commands `beamsplat depth`, `eval depth` and `bench depth`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from beamsplat.common.errors import NothingUseful, UserError
from beamsplat.common.files.persist import make_folder
from beamsplat.tools.cli.depth_tables import print_depth_report
from beamsplat.tools.cli.options import CameraInfoTopic, ImageTopic, OdometryTopic, ScanTopic, writable

if TYPE_CHECKING:
    from beamsplat.tools.evaluation.drive import RecordedDrive

# OpenCV, Numba and onnxruntime are imported inside the commands, so that other commands start fast.

BagArgument = Annotated[Path, typer.Argument(help="A bag, a recording, or a folder that contains bag/.")]
PosesOption = Annotated[
    Path | None,
    typer.Option(
        help="TUM file of T_map_body; default: poses in the recording, else poses of the lidar SLAM."
    ),
]
SourceOption = Annotated[str, typer.Option(help="Name of the depth source.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="OPTION=VALUE", help="Option of the depth source; repeatable"),
]
RigOption = Annotated[
    Path | None, typer.Option(help="Rig file that replaces the calibration in the recording.")
]
FloorOption = Annotated[
    bool | None,
    typer.Option(
        "--floor/--no-floor", help="Whether the camera's height is known; default: if the poses are planar."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


def eval_depth(
    bag: BagArgument,
    truth: Annotated[
        Path, typer.Option(help="Folder of true depth <stamp_ns>.png, or one that contains depth_gt/.")
    ],
    poses: PosesOption = None,
    source: SourceOption = "stixel",
    set_: SetOption = None,
    rig: RigOption = None,
    floor: FloorOption = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="Weights of `train aggregator`: also evaluate the learned aggregation with them."),
    ] = None,
    heldout: Annotated[bool, typer.Option(help="Also evaluate twice with beams held out.")] = True,
    scan_topic: ScanTopic = "",
    image_topic: ImageTopic = "",
    odometry_topic: OdometryTopic = "",
    camera_info_topic: CameraInfoTopic = "",
    as_json: JsonOption = False,
) -> None:
    """Evaluate depth against dense true depth and against held-out beams, for every method.

    The errors are also listed by parts of the image: by height above the floor, by distance, at depth edges.
    The 95 % confidence intervals [low, high] come from a bootstrap over blocks of 5 images. With --weights,
    the learned aggregation (method `learned`) is compared with the default on the same pixels.

    Examples:

        beamsplat eval depth drive --truth drive/depth_gt

        beamsplat eval depth drive --truth drive/depth_gt --source stixel --json

        beamsplat eval depth drive --truth drive/depth_gt --no-heldout --weights out/aggregator.onnx
    """
    import cv2

    from beamsplat.services.depth.source import make_source
    from beamsplat.services.fusion.weights_file import check_weights
    from beamsplat.tools.evaluation.depth_replay import truth_depth_files
    from beamsplat.tools.evaluation.evaluate import evaluate

    learned = None
    if weights is not None:
        from beamsplat.services.fusion.learned_aggregation import LearnedAggregation

        learned = LearnedAggregation(check_weights(weights, "--weights"))
    cv2.setNumThreads(1)  # CPU times are measured on one core
    topics = {
        "scan_topic": scan_topic, "image_topic": image_topic, "odometry_topic": odometry_topic,
        "camera_info_topic": camera_info_topic,
    }  # fmt: skip
    drive = _open(bag, poses, rig, topics)
    with _progress() as bar:
        task = bar.add_task("", total=None)
        report = evaluate(
            drive, make_source(source, options_of(set_)), truth_depth_files(truth), heldout=heldout,
            floor=floor, learned=learned,
            progress=lambda run, done, total: bar.update(
                task, description=run, completed=done, total=total
            ),
        )  # fmt: skip
    report["source"] = source
    if as_json:
        print(json.dumps(report))
    else:
        print_depth_report(report)


def depth(
    data: Annotated[Path, typer.Argument(help="A bag, recording or folder; or one image (.jpg, .png).")],
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for the images.")],
    poses: PosesOption = None,
    source: SourceOption = "stixel",
    set_: SetOption = None,
    rig: RigOption = None,
    floor: FloorOption = None,
    truth: Annotated[Path | None, typer.Option(help="Folder of true depth, shown as well.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Use every n-th image.")] = 8,
    scan_topic: ScanTopic = "",
    image_topic: ImageTopic = "",
    odometry_topic: OdometryTopic = "",
    camera_info_topic: CameraInfoTopic = "",
    as_json: JsonOption = False,
) -> None:
    """Draw panels: image with beams, raw depth, corrected depth, sigma, and true depth if given.

    Examples:

        beamsplat depth drive --out images --poses out/trajectory.tum

        beamsplat depth photo.jpg --out images --rig rig.toml
    """
    from beamsplat.common.runtime.rejections import Rejections
    from beamsplat.services.depth.source import make_source
    from beamsplat.tools.evaluation.depth_panels import draw_depth_of_image, draw_depth_panels

    chosen = make_source(source, options_of(set_))
    make_folder(out)
    if data.is_file() and data.suffix.lower() in (".jpg", ".jpeg", ".png"):
        print(draw_depth_of_image(data, chosen, rig, out))
        return
    topics = {
        "scan_topic": scan_topic, "image_topic": image_topic, "odometry_topic": odometry_topic,
        "camera_info_topic": camera_info_topic,
    }  # fmt: skip
    drive = _open(data, poses, rig, topics)
    with _progress() as bar:
        task = bar.add_task("images", total=None)
        count, refused, useful = 0, Rejections(), 0
        for count, (status, total) in enumerate(
            draw_depth_panels(drive, chosen, truth, every, out, floor, refused.add), start=1
        ):
            bar.update(task, completed=count, total=total)
            useful += status == "ok"
            if status != "ok":
                refused.add(status)
    reasons = {entry.reason: entry.count for entry in refused.report()}
    if as_json:
        print(json.dumps({"images": count, "with_depth": useful, "refused": reasons}))
    else:
        print(f"{count} images in {out}, {useful} with depth")
        for reason, number in reasons.items():
            print(f"{number} without: {reason}")
    if not useful:
        raise NothingUseful(f"{data}: no image has depth ({', '.join(reasons) or 'there are no images'})")


def bench_depth(
    source: SourceOption = "stixel",
    frames: Annotated[int, typer.Option(min=5, help="Frames timed.")] = 60,
    as_json: JsonOption = False,
) -> None:
    """Measure CPU milliseconds per 640x480 image: depth source, fusion of an image, fusion of a keyframe.

    Example: beamsplat bench depth --source stixel
    """
    from beamsplat.tools.bench.depth import bench

    figures = bench(source, frames)
    if as_json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name}: {value:.1f}" if isinstance(value, float) else f"{name}: {value}")


def options_of(pairs: list[str] | None) -> dict[str, Any]:
    """Return the options of a depth source from texts `name=value`, by name.

    Values are parsed as TOML; a value that is not TOML is a string.

    Raises:
        UserError: a text does not have the form `name=value`.
    """
    import tomllib

    options: dict[str, Any] = {}
    for pair in pairs or []:
        name, equals, text = pair.partition("=")
        if not equals or not name.isidentifier():
            raise UserError(f"--set {pair!r}: expected OPTION=VALUE, for example model=my.onnx")
        try:
            options[name] = tomllib.loads(f"v = {text}")["v"]
        except tomllib.TOMLDecodeError:
            options[name] = text
    return options


def _open(bag: Path, poses: Path | None, rig: Path | None, topics: dict[str, str]) -> RecordedDrive:
    from beamsplat.tools.evaluation.drive import open_drive

    return open_drive(bag, poses, rig, topics)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=Console(stderr=True),
    )  # fmt: skip
