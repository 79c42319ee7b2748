"""`beamsplat session edit` and `undo`: remove parts of a saved map by hand, and put them back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.session import SessionArgument
from beamsplat.tools.sessions.opened import faults_explained, locked, read_saved, write_saved

if TYPE_CHECKING:
    import numpy as np

_HIGHEST_M = 1000.0


def edit(
    session: SessionArgument,
    keep: Annotated[
        list[str] | None,
        typer.Option(help='Polygon on the floor, "X,Y X,Y X,Y ..." (m): remove what is outside; repeatable'),
    ] = None,
    remove: Annotated[
        list[str] | None,
        typer.Option(help='Polygon on the floor, "X,Y X,Y X,Y ..." (m): remove what is inside; repeatable'),
    ] = None,
    low_m: Annotated[
        float,
        typer.Option(min=-_HIGHEST_M, max=_HIGHEST_M, help="Remove only above this height over the floor"),
    ] = -_HIGHEST_M,
    high_m: Annotated[
        float,
        typer.Option(min=-_HIGHEST_M, max=_HIGHEST_M, help="Remove only below this height over the floor"),
    ] = _HIGHEST_M,
    floaters: Annotated[
        int,
        typer.Option(min=0, help="Remove groups of fewer Gaussians than this that touch nothing else"),
    ] = 0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be removed")] = False,
) -> None:
    """Remove parts of a saved map: by place, by height, or because they float in the air.

    Polygons are in the map frame, as the map views show it: x and y in metres from where the drive started.
    Without polygons, all of the map between --low-m and --high-m is meant, so that `--low-m 2.2` alone takes
    the ceiling away. What is removed is kept beside the map: `beamsplat session undo` puts it back. The lidar
    map is not changed.

    Examples:

        beamsplat session edit map --floaters 30

        beamsplat session edit map --keep "-1,-1 8,-1 8,5 -1,5"

        beamsplat session edit map --remove "2,1 3,1 3,2 2,2" --high-m 1.8
    """
    from beamsplat.tools.sessions.edit import with_gaussians
    from beamsplat.tools.sessions.undo import RemovedGaussians

    areas = {"--keep": keep or [], "--remove": remove or []}
    polygons = {name: [_parsed(name, text) for text in texts] for name, texts in areas.items()}
    heights = (low_m, high_m) != (-_HIGHEST_M, _HIGHEST_M)
    if not (keep or remove or heights or floaters):
        raise UserError("nothing to be removed: give --keep, --remove, --low-m, --high-m or --floaters")
    with locked(session, shared=dry_run) as folder:
        arrays = read_saved(folder)
        params = arrays["store_params"]
        gone = _chosen(params, polygons["--keep"], polygons["--remove"], (low_m, high_m), heights)
        if floaters:
            gone |= _floating(params, gone, floaters)
        count = int(gone.sum())
        told = f"{session}: {count} of {params.shape[1]} Gaussians"
        if count == params.shape[1]:
            raise UserError(f"{told} would be removed: nothing would be left")
        if dry_run or count == 0:
            print(f"{told} would be removed")
            return
        with faults_explained(folder):  # first, so that nothing is lost if the program ends between the two
            RemovedGaussians(folder.edge).push(arrays, gone, f"{count} Gaussians removed")
        write_saved(folder, with_gaussians(arrays, ~gone))
    print(f"{told} removed; `beamsplat session undo {session}` puts them back")


def undo(session: SessionArgument) -> None:
    """Put back what the newest `beamsplat session edit` removed; repeat it for the edits before.

    Example: beamsplat session undo map
    """
    from beamsplat.tools.sessions.undo import RemovedGaussians, put_back

    with locked(session) as folder:
        arrays, removed = read_saved(folder), RemovedGaussians(folder.edge)
        path, text, saved = removed.newest()
        write_saved(folder, put_back(arrays, saved))
        path.unlink()
        left = len(removed)
    print(f"{session}: undone: {text}; {left} edits before it can be undone")


def _parsed(name: str, text: str) -> np.ndarray:
    """Return the corners float64 [K, 2] of a polygon "X,Y X,Y X,Y ..."."""
    import numpy as np

    try:
        corners = np.array([[float(number) for number in pair.split(",")] for pair in text.split()])
    except ValueError:
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise UserError(f'{name} "{text}": expected at least three corners "X,Y X,Y X,Y" in metres')
    return corners


def _chosen(
    params: np.ndarray, keep: list[np.ndarray], remove: list[np.ndarray], heights_m: tuple[float, float],
    by_height: bool,
) -> np.ndarray:  # fmt: skip
    """Return bool [N]: the Gaussians [14, N] outside all `keep`, or inside a `remove`, within the heights."""
    import numpy as np

    from beamsplat.tools.sessions.selection import in_polygon

    xy = params[:2].T.astype(np.float64)
    gone = np.zeros(len(xy), bool)
    if keep:
        gone |= ~np.any([in_polygon(xy, polygon) for polygon in keep], axis=0)
    for polygon in remove:
        gone |= in_polygon(xy, polygon)
    if by_height and not (keep or remove):
        gone[:] = True
    return gone & (params[2] >= heights_m[0]) & (params[2] < heights_m[1])


def _floating(params: np.ndarray, gone: np.ndarray, smallest: int) -> np.ndarray:
    """Return bool [N]: floaters among the Gaussians that are not `gone`."""
    import numpy as np

    from beamsplat.tools.sessions.selection import floaters

    out = np.zeros(len(gone), bool)
    out[~gone] = floaters(params[:, ~gone], smallest)
    return out
