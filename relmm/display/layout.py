"""Where everything stands in the viewer."""

from __future__ import annotations

from typing import Any

# Names of what is shown, in the recording.
CAMERA, ATTEMPT, FLOOR, DOING = "camera", "camera/attempt", "floor", "doing"
WHERE, TRACK, ATTEMPTS, ROBOT = "where", "where/track", "where/attempts", "where/robot"
BELIEF, SUCCESS, OBJECTS, LEARNING = "belief", "success", "objects", "learning"
FRAME = "frame"  # the timeline: frames since the command began


def blueprint(floor: bool, learning: bool) -> Any:
    """A `rerun.blueprint.Blueprint`.

    Args:
        floor: whether the policy remembers a floor that can be shown.
        learning: whether it learns, so that there are metrics.
    """
    import rerun.blueprint as rrb

    pictures = [rrb.Spatial2DView(origin=CAMERA, name="what the robot sees, and where it grasps")]
    if floor:
        pictures.append(rrb.Spatial2DView(origin=FLOOR, name="the floor that it remembers, and its plan"))
    where = rrb.Spatial2DView(origin=WHERE, name="where it was lately, by its wheels")
    share = rrb.ScalarAxis(range=(0.0, 1.0))
    curves = [
        rrb.TimeSeriesView(origin=BELIEF, name="P[grasp]", axis_y=share),
        rrb.TimeSeriesView(origin=SUCCESS, name="success of attempts", axis_y=share),
        rrb.TimeSeriesView(origin=OBJECTS, name="objects picked up"),
        *([rrb.TimeSeriesView(origin=LEARNING, name="learning")] if learning else []),
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*pictures, where),
            rrb.Horizontal(rrb.TextDocumentView(origin=DOING, name="what it does"), *curves),
            row_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=FRAME, state="collapsed"),
        collapse_panels=True,
    )
