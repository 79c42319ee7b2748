"""`beamsplat view`: the 3D viewer in a browser."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from beamsplat.tools.cli.browser import BrowserOption, open_in_browser

console = Console(stderr=True)
_CHECK_S = 0.5


def view(
    map_: Annotated[
        Path,
        typer.Argument(
            metavar="MAP",
            help="Folder of a session or of a demo, a .ply file of 3D Gaussian splats, or the deployment "
            "file (.toml) of a running system",
        ),
    ],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 = any free one")] = 8421,
    bind: Annotated[
        str, typer.Option(help="Address to listen at; 0.0.0.0 lets everybody in the network see the map")
    ] = "127.0.0.1",
    up: Annotated[str, typer.Option(help=".ply: the axis of the file that points up: z, y or -y")] = "z",
    browser: BrowserOption = True,
) -> None:
    """Show a map in a browser, in 3D, until Ctrl-C: saved maps, splat files of any trainer, running systems.

    Orbit and fly through the map, measure, cut by height, and compare renders with the camera's images.
    Nothing is loaded from other hosts.

    Examples:

        beamsplat view out/demo

        beamsplat view garden.ply --up -y

        beamsplat view deploy/robot.toml --port 0 --no-browser
    """
    from beamsplat.services.page.static_files import read_viewer
    from beamsplat.tools.view.serving import MapViewer

    if "viewer.js" not in read_viewer():
        console.print("The 3D viewer is not built, so the page can only say so: run `make web`.")
    with console.status(f"reading {map_}"):
        viewer = MapViewer(map_, bind, port, up)
    with viewer:
        print(viewer.address, flush=True)
        if browser and not open_in_browser(viewer.address):
            console.print("Open this address in a browser. Ctrl-C ends it.")
        try:
            while True:
                time.sleep(_CHECK_S)
                viewer.check()
        except KeyboardInterrupt:
            pass
