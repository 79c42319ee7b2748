"""The layout of the rerun viewer: the map large, the camera beside it, health below."""

from __future__ import annotations

import rerun.blueprint as rrb

from beamsplat.services.monitor.depth_layer import CLOUD, DEPTH
from beamsplat.services.monitor.map_layer import PLOTS as MAP_PLOTS
from beamsplat.services.monitor.map_layer import RENDER, SPLATS
from beamsplat.services.monitor.panel import PLOTS
from beamsplat.services.monitor.rerun_writer import TIMELINE
from beamsplat.services.monitor.scene import BODY, CAMERA, SCAN, WORLD


def layout() -> rrb.Blueprint:
    """Return the layout (blueprint) of the viewer."""
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=(-5.0, -5.0, 7.0), look_target=(0.0, 0.0, 0.0),
        eye_up=(0.0, 0.0, 1.0), tracking_entity=f"/{BODY}",
    )  # fmt: skip
    # Gaussians are created at the points and would hide them: each has its own view.
    world = rrb.Tabs(
        rrb.Spatial3DView(
            origin=WORLD, contents=["$origin/**", f"- /{CLOUD}/**"], name="Map", eye_controls=eye
        ),
        rrb.Spatial3DView(
            origin=WORLD, contents=["$origin/**", f"- /{SPLATS}/**"], name="Points", eye_controls=eye
        ),
    )
    # The scan is projected into the image, so that a wrong calibration is visible.
    camera = rrb.Spatial2DView(origin=CAMERA, contents=["$origin/**", f"/{SCAN}"], name="Camera")
    plots = [
        rrb.TimeSeriesView(
            origin=f"plots/{quantity}", name=name, plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop)
        )
        for quantity, name in {**MAP_PLOTS, **PLOTS}.items()
    ]
    health = rrb.Tabs(
        rrb.TextDocumentView(origin="health/table", name="Nodes"),
        rrb.StateTimelineView(origin="health/state", name="States"),
        *plots[4:],
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                world,
                rrb.Vertical(
                    camera,
                    rrb.Tabs(
                        rrb.Spatial2DView(origin=RENDER, name="Render"),
                        rrb.Spatial2DView(origin=DEPTH, name="Depth"),
                        rrb.TextLogView(origin="log", name="Log"),
                    ),
                    row_shares=[3, 2],
                ),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(health, *plots[:4], column_shares=[3, 2, 2, 2, 2]),
            row_shares=[5, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )
