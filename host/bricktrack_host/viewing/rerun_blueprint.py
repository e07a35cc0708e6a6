"""How the viewer is arranged when it opens a run: space and picture left, curves and words right."""

import rerun.blueprint as rrb

from bricktrack_host.viewing.rerun_recording import CAMERA

_WINDOW_S = 2.0


def run_blueprint(timeline: str, *, with_camera: bool) -> "rrb.Blueprint":
    """Return the arrangement; the curves show what is around the instant that the time panel is at.

    Without a camera in space, ``with_camera``, the picture has no place there.
    """
    space = rrb.Spatial3DView(
        origin="world",
        contents=["$origin/**"] if with_camera else ["$origin/**", f"- /{CAMERA}/**"],
        name="Brick, rays and camera" if with_camera else "Brick",
        eye_controls=rrb.EyeControls3D(position=[190, -130, -60], look_target=[0, 0, 130], eye_up=[0, -1, 0]),
        line_grid=False,
    )
    picture = rrb.Spatial2DView(origin=CAMERA, name="What the camera saw")
    around_now = rrb.VisibleTimeRange(
        timeline,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=_WINDOW_S),
    )

    def curves(name: str, *views: tuple[str, str]) -> rrb.Vertical:
        panels = [
            rrb.TimeSeriesView(origin=origin, name=title, time_ranges=around_now) for origin, title in views
        ]
        return rrb.Vertical(*panels, name=name)

    tabs = rrb.Tabs(
        curves("Displacement", *((f"motion/displacement_mm/{c}", f"{c} from rest, mm") for c in "xyz")),
        curves("Rotation", *((f"motion/rotation_deg/{c}", f"about {c} from rest, deg") for c in "xyz")),
        curves(
            "Inertial sensor",
            ("imu/acceleration", "Specific force, brick axes, m/s²"),
            ("imu/angular_rate", "Angular rate, brick axes, deg/s"),
        ),
        rrb.TimeSeriesView(origin="residuals", name="Residuals, px"),
    )
    words = rrb.Horizontal(
        rrb.TextDocumentView(origin="about", name="About"),
        rrb.TextLogView(origin="events", name="Events"),
        name="Words",
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(space, picture),
            rrb.Vertical(tabs, words, row_shares=[7, 3]),
            column_shares=[5, 5],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline),
        auto_views=False,
    )
