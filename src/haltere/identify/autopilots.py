"""A drag model as the parameters that PX4 and ArduPilot take, ready to paste, within their limits. It sends nothing anywhere."""

from __future__ import annotations

from haltere.identify.drag import DragIdentification
from haltere.identify.projection import Projection

__all__ = ["ardupilot_parameters", "parameter_sd", "px4_parameters", "remarks"]

#: Limits of the parameters. PX4: src/modules/ekf2/params_drag.yaml; below 1 kg/m^2 and 0.001 1/s a part counts as off, noise below
#: 0.5 (m/s^2)^2 as that. ArduPilot: libraries/AP_NavEKF3/AP_NavEKF3.cpp, with the same thresholds, noise below 0.5 m/s^2 as that.
PX4_BCOEF, PX4_NOISE = (0.0, 200.0), (0.5, 10.0)
ARDUPILOT_BCOEF, ARDUPILOT_NOISE = (0.0, 1000.0), (0.5, 2.0)
MCOEF = (0.0, 1.0)


def _ballistic(p: Projection, k: int, high: float) -> float:
    """Ballistic coefficient [kg/m^2] of an inverse; 0, off, where there is none or it is beyond the limit."""
    inverse = float(p.values[k])
    return 1.0 / inverse if inverse > 0.0 and 1.0 < 1.0 / inverse <= high else 0.0


def _clipped(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])


def px4_parameters(d: DragIdentification) -> dict[str, float]:
    """Parameters of PX4, with what switches the estimation on; the noise is a variance [(m/s^2)^2]."""
    return {
        "EKF2_DRAG_CTRL": 1.0,
        "EKF2_MCOEF": _clipped(float(d.px4.values[0]), MCOEF),
        "EKF2_BCOEF_X": _ballistic(d.px4, 1, PX4_BCOEF[1]),
        "EKF2_BCOEF_Y": _ballistic(d.px4, 2, PX4_BCOEF[1]),
        "EKF2_DRAG_NOISE": _clipped(d.force_sd**2, PX4_NOISE),
    }


def ardupilot_parameters(d: DragIdentification) -> dict[str, float]:
    """Parameters of ArduPilot; drag fusion is on where one of them is above its threshold. The noise is 1 sigma [m/s^2]."""
    return {
        "EK3_DRAG_MCOEF": _clipped(float(d.ardupilot.values[0]), MCOEF),
        "EK3_DRAG_BCOEF_X": _ballistic(d.ardupilot, 1, ARDUPILOT_BCOEF[1]),
        "EK3_DRAG_BCOEF_Y": _ballistic(d.ardupilot, 2, ARDUPILOT_BCOEF[1]),
        "EK3_DRAG_M_NSE": _clipped(d.force_sd, ARDUPILOT_NOISE),
    }


def parameter_sd(d: DragIdentification, autopilot: str) -> dict[str, float]:
    """1 sigma of MCOEF and BCOEF of an autopilot (``px4`` or ``ardupilot``); those that are off are left out."""
    p: Projection = getattr(d, autopilot)
    values = px4_parameters(d) if autopilot == "px4" else ardupilot_parameters(d)
    stem = "EKF2_" if autopilot == "px4" else "EK3_DRAG_"
    sd = d.sd(p)
    out = {f"{stem}MCOEF": float(sd[0])}
    for k, axis in ((1, "X"), (2, "Y")):
        b = values[f"{stem}BCOEF_{axis}"]
        if b > 0.0:
            out[f"{stem}BCOEF_{axis}"] = float(sd[k]) * b * b
    return out


def remarks(d: DragIdentification) -> list[str]:
    """What to know before pasting."""
    out = [
        "the autopilots' filters take the thrust for exactly along body z and one MCOEF for both axes; offsets found here are not in them",
        "a BCOEF of 0 switches the body's drag off on that axis: the flights do not tell it, or it is beyond the limit",
    ]
    if float(d.px4.values[0]) > MCOEF[1] or float(d.ardupilot.values[0]) > MCOEF[1]:
        out.append("MCOEF is above the autopilots' limit of 1 and was cut to it")
    if d.density < 1.15:
        out.append(
            f"ArduPilot's drag fusion takes a density that rises with height: its parameters hold near this place's {d.density:.2f} kg/m^3"
        )
    if d.force_sd**2 < PX4_NOISE[0]:
        out.append(
            f"drag noise found {d.force_sd:.2f} m/s^2 (1 sigma, gusts included); both filters take at least 0.5 (m/s^2)^2 and 0.5 m/s^2"
        )
    return out
