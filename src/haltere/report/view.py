"""The flight in three dimensions: tracks, and an airframe that turns as the vehicle did. The turning itself is done in the page."""

from __future__ import annotations

from typing import Any

from haltere.metrics.errors import reference_position
from haltere.report.context import Context
from haltere.report.markup import Section
from haltere.report.overview import fixes
from haltere.report.panels import Figure
from haltere.report.sections import angle_columns

__all__ = ["view"]

#: Of an axis of the scene.
_AXIS = {
    "color": "@text", "gridcolor": "@grid", "zerolinecolor": "@axis", "linecolor": "@axis", "showbackground": False,
    "showspikes": False, "nticks": 6, "title": {"text": ""},
}  # fmt: skip


def view(c: Context) -> Section:
    """Track with body axes and a movable airframe; the airframe alone where the position is not known.

    Parameters
    ----------
    c
        The solution and its flight.

    Returns
    -------
    Section
        With one figure of kind ``3d``: height up, in metres, on equal scales. Its ``pose`` names the arrays of roll, pitch, yaw
        [deg] and of north, east, down [m], each with the array of its times.
    """
    placed = "pos_n" in c.solution and c.held_by_measurement
    t = c.solution.t
    angles = [c.pool.series(*angle_columns(c, k))[:2] for k in range(3)]
    figure: Figure = {
        "name": "view", "kind": "3d", "traces": [], "height": 520 if placed else 400, "time": False, "pose": {"angles": angles},
        "layout": {"margin": {"l": 0, "r": 0, "t": 40, "b": 4}, "hovermode": "closest", "scene": _scene(placed)},
    }  # fmt: skip
    note = "The airframe stands where the slider, or the pointer on another plot, says; drag to turn the view. Its size is not to scale."
    if not placed:
        return Section("view", "Attitude in 3-D", note, [figure])
    ids = c.pool.series(t, list(c.solution.vector("pos", "ned").T), [1e-3] * 3, even=True)
    figure["pose"]["position"] = [[ids[0], i] for i in ids[1:]]
    figure["windowed"] = {"ids": ids}
    at, p = fixes(c)
    tracks = [("GNSS fixes", "gnss", c.pool.series(at, list(p.T), [1e-3] * 3, even=True), True), ("estimate", "estimate", ids, False)]
    for name, stream in c.references:
        tp, pr = reference_position(stream, list(c.origin) if c.origin else None)
        tracks.append((name, name, c.pool.series(tp, list(pr.T), [1e-3] * 3, even=True), False))
    figure["traces"] += [_track(*track) for track in tracks if track[2]]
    figure["traces"].append(
        _track("time shown", "event", ids, False) | {"$track": {"ids": ids, "window": True}, "line": {"width": 7, "color": "@event"}}
    )
    return Section("view", "Track and attitude in 3-D", note, [figure])


def _scene(placed: bool) -> dict[str, Any]:
    titles = ("east [m]", "north [m]", "height [m]") if placed else ("east", "north", "up")
    scene: dict[str, Any] = {
        f"{a}axis": {**_AXIS, "title": {"text": title}, **({} if placed else {"showticklabels": False})}
        for a, title in zip("xyz", titles, strict=True)
    }
    return scene | {
        "aspectmode": "cube",
        "dragmode": "orbit",
        "uirevision": "kept",
        "camera": {"eye": {"x": -0.85, "y": -1.5, "z": 0.85}, "center": {"x": 0, "y": 0, "z": -0.22}},
    }


def _track(name: str, colour: str, ids: list[int], dots: bool) -> dict[str, Any]:
    look = (
        {"marker": {"size": 2, "color": f"@{colour}"}}
        if dots
        else {"line": {"color": f"@{colour}", "width": 4 if colour == "estimate" else 2}}
    )
    return {
        "type": "scatter3d", "name": name, "$track": {"ids": ids}, "mode": "markers" if dots else "lines", **look,
        "hovertemplate": "N %{y:.2f} m, E %{x:.2f} m, height %{z:.2f} m<br>t = %{customdata[0]:.2f} s",
    }  # fmt: skip
