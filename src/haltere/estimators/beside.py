"""What runs beside the filter where its layout has it: vehicle model, diagnosis of the IMU. Who does not have it compiles none of it."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit, where
from haltere.core.rotation import Mat, Vec
from haltere.diagnosis import inertial, model_detectors, model_faults, pairs, stand_in, steps
from haltere.filter.rotors import rotors_at

__all__ = ["across", "begin_anew", "carry", "compare", "couple", "diagnose", "hold", "turning"]


@jit
def _compare(s: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> tuple[Vec, Vec, Vec, Vec]:
    w_raw, f_raw = w1, f1
    w0, f0, w1, f1 = stand_in.stand_in(s, prm, w0, f0, w1, f1, dt)
    s.w_raw[0], s.w_raw[1], s.w_raw[2] = w1
    s.f_raw[0], s.f_raw[1], s.f_raw[2] = f1
    if pairs.gather(s, prm, w_raw, f_raw, dt):
        model_faults.hear(s, prm)
    model_detectors.drive(s, prm, dt)
    return w0, f0, w1, f1


@jit
def _as_they_are(s: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> tuple[Vec, Vec, Vec, Vec]:
    return w0, f0, w1, f1


@jit
def _couple(s: Any, prm: Any, dt: float) -> None:
    if stand_in.stands(s):
        stand_in.couple(s, prm, dt)


@jit
def _no_couple(s: Any, prm: Any, dt: float) -> None:
    return


@jit
def _across(s: Any) -> bool:
    return stand_in.across(s)


@jit
def _not_across(s: Any) -> bool:
    return False


@jit
def _hold(s: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec) -> tuple[Vec, Vec]:
    return stand_in.hold(s, w0, f0, w1, f1)


@jit
def _no_hold(s: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec) -> tuple[Vec, Vec]:
    return w1, f1


@jit
def _begin_anew(s: Any) -> None:
    stand_in.forget(s)
    pairs.restart(s)
    model_detectors.forget(s)


@jit
def _nothing(s: Any) -> None:
    return


@jit
def _turning(s: Any, t: float) -> None:
    rotors_at(s, t)


@jit
def _no_rotors(s: Any, t: float) -> None:
    return


@jit
def _carry(s: Any, D: Mat, A: Mat, B: Mat, dt: float) -> None:
    inertial.carry(s, D, A, B, dt)


@jit
def _no_carry(s: Any, D: Mat, A: Mat, B: Mat, dt: float) -> None:
    return


@jit
def _diagnose(s: Any, prm: Any, t: float, dt: float, w: Vec, f: Vec) -> bool:
    found = steps.watch(s, prm, t, dt, w, f)
    return inertial.tick(s, prm, dt) or found


@jit
def _no_diagnosis(s: Any, prm: Any, t: float, dt: float, w: Vec, f: Vec) -> bool:
    return False


#: The vehicle's model against the raw samples at both ends of an interval, and its own in place of axes that are not to be used.
compare = where("pairs", _compare, _as_they_are)
#: After prediction: what the model, where it stands in, carries from state to state.
couple = where("pairs", _couple, _no_couple)
#: Whether the model stands in for the accelerometer across the thrust axis.
across = where("pairs", _across, _not_across)
#: A raw sample with the one before in place of axes that the model stands in for.
hold = where("pairs", _hold, _no_hold)
#: The model begins anew, after alignment.
begin_anew = where("pairs", _begin_anew, _nothing)
#: The rotor speeds at a time.
turning = where("model", _turning, _no_rotors)
#: Responses to faults of the IMU through one prediction.
carry = where("bank", _carry, _no_carry)
#: Raw samples and innovations up to now; whether a fault was found whose effect was taken back.
diagnose = where("bank", _diagnose, _no_diagnosis)
