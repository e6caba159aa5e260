"""Inertial navigation for small multirotors; this page is its conventions. It loads nothing heavy until a name is used.

Everything in the package, in its files and on its command line follows this page. Foreign conventions end at the reader.

**Units.** SI and radians, in memory and in files: rad/s, m/s², m/s, m, Pa, s. Exceptions, by custom: latitude and longitude are degrees,
magnetic field is µT, temperature is °C. A rotor command is a fraction, 0 to 1.

**Frames.**

=====  ====================================================================================================================
``n``  navigation: North-East-Down (NED), a local tangent plane whose origin is home (``[home]``, else the first 3-D fix)
``b``  body: Forward-Right-Down (FRD), fixed to the vehicle, origin at the IMU; only rotor positions count from the centre of gravity
=====  ====================================================================================================================

Altitude (``alt``) is the exception that points up, in metres above mean sea level; ``pos_d`` and ``vel_d`` point down.

**Names carry their frame.** ``vel_n`` is a velocity resolved in n, ``gyro_b`` an angular rate resolved in b, ``q_nb`` and ``C_nb`` take
coordinates from b to n: ``v_n = C_nb v_b``. In tables one column is one component: ``gyro_x, gyro_y, gyro_z`` are body axes,
``vel_n, vel_e, vel_d`` are north, east, down. ``sd_*`` is one standard deviation.

**Attitude.** The unit quaternion ``q_nb = [q_w, q_x, q_y, q_z]`` is scalar first, Hamilton product, body to navigation. With w, x, y, z::

            | w² + x² - y² - z²    2(xy - wz)           2(xz + wy)        |
    C_nb =  | 2(xy + wz)           w² - x² + y² - z²    2(yz - wx)        |
            | 2(xz - wy)           2(yz + wx)           w² - x² - y² + z² |

Euler angles are yaw ψ, then pitch θ, then roll φ, ``C_nb = Rz(ψ) Ry(θ) Rx(φ)``: ``ψ = atan2(C21, C11)``, ``θ = -asin(C31)``,
``φ = atan2(C32, C33)`` (rows and columns from 1). Yaw is zero towards true north and grows towards east, pitch grows nose up,
roll right side down. Kinematics: ``dq/dt = ½ q ⊗ [0, ω_b]``.

**Signs.**

* An accelerometer measures *specific force*, not acceleration and not gravity: ``f_b = C_nbᵀ (a_n - g_n)`` with ``g_n = [0, 0, +g]``.
  At rest and level, ``accel_z = -9.81``.
* Wind is the velocity of the air over ground, where it blows *to*: ``vel_n = vel_air_n + wind_n``.
  A weather report names where it comes *from*.
* A rotor's spin is +1 if it turns counter-clockwise seen from above; its reaction then yaws the vehicle clockwise, +z.
  Rotor speeds are positive.
* Magnetic declination is positive when magnetic north lies east of true north; dip is positive when the field points down.
* A bias is measured minus true: it is subtracted from the measurement.

**Error state.** ``q_true = q̂ ⊗ δq(δθ)`` with ``δq ≈ [1, δθ/2]``: the attitude error is a small rotation resolved in b.
All other errors are true minus estimate and add. The core order, the same in every layout, is δθ, δvel_n, δpos_n, δgyro_bias,
δaccel_bias; optional blocks follow. The innovation is measured minus predicted.

**Time.** ``t`` is seconds, float64. A foreign log is shifted so that t = 0 is its earliest navigation sample
(log clock = t + ``time_offset``); a flight folder keeps its times. A sample stamped t was valid at t - delay.
A missing value is NaN, never zero; a missing stream is absent.

**Noise.** Continuous noise is a density: σ of one sample is density / √dt. Parameters hold for every sample rate.

Use::

    import haltere

    flight = haltere.read("flight.ulg")
    solution = haltere.run(flight, "navigator")
    solution.save("flight.haltere")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from haltere._version import __version__

if TYPE_CHECKING:
    from haltere.calibrate.magnetometer import calibrate_magnetometer
    from haltere.drive import run
    from haltere.errors import HaltereError
    from haltere.estimators.base import Estimator
    from haltere.evaluate.campaign import campaign
    from haltere.evaluate.compare import compare
    from haltere.flight.given_wind import with_wind
    from haltere.flight.log import FlightLog, FlightMeta, Home, Stream
    from haltere.flight.solution import Solution
    from haltere.identify.drag import identify_drag
    from haltere.identify.vehicle import identify_vehicle
    from haltere.readers import read
    from haltere.simulate import Scenario, inject, simulate

__all__ = [
    "Estimator", "FlightLog", "FlightMeta", "HaltereError", "Home", "Scenario", "Solution", "Stream", "__version__",
    "calibrate_magnetometer", "campaign", "compare", "identify_drag", "identify_vehicle", "inject", "read", "run", "simulate", "with_wind",
]  # fmt: skip

# Where each public name lives: loaded at its first use, so that `import haltere` costs no numba, polars or scipy.
_HOME = {
    "Estimator": "haltere.estimators.base",
    "FlightLog": "haltere.flight.log",
    "FlightMeta": "haltere.flight.log",
    "HaltereError": "haltere.errors",
    "Home": "haltere.flight.log",
    "Scenario": "haltere.simulate",
    "Solution": "haltere.flight.solution",
    "Stream": "haltere.flight.log",
    "calibrate_magnetometer": "haltere.calibrate.magnetometer",
    "campaign": "haltere.evaluate.campaign",
    "compare": "haltere.evaluate.compare",
    "identify_drag": "haltere.identify.drag",
    "identify_vehicle": "haltere.identify.vehicle",
    "inject": "haltere.simulate",
    "read": "haltere.readers",
    "run": "haltere.drive",
    "simulate": "haltere.simulate",
    "with_wind": "haltere.flight.given_wind",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'haltere' has no attribute {name!r}")
    home = import_module(_HOME[name])
    # a room of that name is there to stay, whoever imports it, and can be called itself
    value = home if home.__name__ == f"{__name__}.{name}" else getattr(home, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
