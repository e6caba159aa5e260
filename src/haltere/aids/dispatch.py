"""Which measurement goes to which aid: one ``if`` line a sensor, and when pseudo-measurements are due. It decides nothing else."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit, where
from haltere.aids import (
    airspeed,
    attitude,
    barometer,
    compass,
    drag,
    fake,
    first_stage,
    gnss,
    interference,
    magnetometer,
    orthonormal_field,
    rest,
    vanes,
    wind,
    zero_rate,
    zero_velocity,
)
from haltere.aids.air import SILENT, AirOffer
from haltere.aids.fusing import NOTHING, Offer, fuse_offer
from haltere.aids.record import (
    AIRSPEED,
    ATTITUDE,
    BAROMETER,
    DRAG,
    FAKE_POSITION,
    FAKE_VELOCITY,
    GNSS_POSITION,
    GNSS_VELOCITY,
    MAGNETOMETER,
    N_QUEUED,
    NO_SIDESLIP,
    POWER,
    ROTORS,
    VANES,
    WIND,
    ZERO_RATE,
    ZERO_VELOCITY,
)
from haltere.core.rotation import Vec
from haltere.filter.queue import pop_due

__all__ = ["N_SENSORS", "air_offer_of", "due", "fuse_all", "offer_of"]

N_SENSORS = 16


@jit
def offer_of(s: Any, prm: Any, sensor: int, m: Any, aids: Any, dt: float, w: Vec, resting: bool, stage: Any) -> Offer:
    """What a sensor has to say: of the queued measurement ``m``, or of itself where it is a pseudo-sensor."""
    if sensor == GNSS_VELOCITY:
        return gnss.offer_velocity(s, prm, m)
    if sensor == GNSS_POSITION:
        return gnss.offer_position(s, prm, m, aids, dt)
    if sensor == BAROMETER:
        return barometer.offer(s, prm, m, aids)
    if sensor == MAGNETOMETER:
        if stage is not None:
            return orthonormal_field.offer(s, stage[0], prm, m, aids)
        return magnetometer.offer(s, prm, m, aids)
    if sensor == POWER:
        interference.hear(s, m.t, m.z[0])
        return NOTHING
    if sensor == ROTORS:
        drag.hear(s, m.t, m.z[0])
        return NOTHING
    if sensor == ATTITUDE:
        return attitude.offer(s, prm, m)
    if sensor == ZERO_VELOCITY:
        return zero_velocity.offer(s, prm)
    if sensor == ZERO_RATE:
        return zero_rate.offer(s, prm, w)
    if sensor == FAKE_VELOCITY:
        return fake.offer_velocity(s, prm)
    if sensor == FAKE_POSITION:
        return fake.offer_position(s, prm, resting)
    return NOTHING


@jit
def air_offer_of(s: Any, prm: Any, sensor: int, m: Any) -> AirOffer:
    """The same of the sensors of the air, whose rows are wider."""
    if sensor == AIRSPEED:
        return airspeed.offer(s, prm, m)
    if sensor == VANES:
        return vanes.offer(s, prm, m)
    if sensor == WIND:
        return wind.offer(s, prm, m)
    if sensor == DRAG:
        return drag.offer(s, prm)
    if sensor == NO_SIDESLIP:
        return vanes.offer_no_sideslip(s, prm)
    return SILENT


@jit
def no_air_offer(s: Any, prm: Any, sensor: int, m: Any) -> AirOffer:
    """Without a wind nothing of the air is heard."""
    return SILENT


air_offer = where("wind", air_offer_of, no_air_offer)


@jit
def of_the_air(sensor: int) -> bool:
    """Whether `air_offer_of` speaks for a sensor."""
    return sensor in (AIRSPEED, VANES, WIND, DRAG, NO_SIDESLIP)


@jit
def due(s: Any, prm: Any, sensor: int, w: Vec, f: Vec) -> bool:
    """Is this pseudo-measurement to be made now? Its clock (10 Hz at rest, 5 Hz fake), its switch, its conditions."""
    a = s.aid[sensor]
    if s.t < a.t_due:
        return False
    a.t_due = s.t + (0.1 if sensor in (ZERO_VELOCITY, ZERO_RATE, DRAG) else 0.2) - 1e-6
    if sensor == ZERO_VELOCITY:
        return prm.aid_zero_velocity > 0.0 and rest.at_rest(s, prm, w, f)
    if sensor == ZERO_RATE:
        return prm.aid_zero_rate > 0.0 and rest.at_rest(s, prm, w, f)
    if sensor == DRAG:
        if len(s.drag) == 0:
            a.t_due = 1e18
            return False
        return drag.airborne(s, prm, w, f)
    if sensor == NO_SIDESLIP:
        if not (prm.aid_no_sideslip == 1.0 and len(s.wind) > 0):
            a.t_due = 1e18
            return False
        return True
    if sensor == FAKE_VELOCITY:
        return prm.aid_fake_velocity > 0.0
    if fake.position_is_lost(s):
        return prm.aid_fake_position > 0.0
    for i in range(3):
        s.anchor[i] = s.p[i]
    return False


@jit
def fuse_all(s: Any, prm: Any, aids: Any, dt: float, w: Vec, f: Vec, first: int, end: int, stage: Any) -> None:
    """Fuse every queued measurement valid at or before the state's time, sensor by sensor, then the pseudo-measurements due.

    Only of sensors ``first`` ... ``end`` - 1.
    """
    sensor = first
    while sensor < end:
        i, t = 0, s.t
        if sensor < N_QUEUED:
            i = pop_due(s, sensor, s.t)
            if i >= 0:
                t = s.ring[sensor, i].t
                s.aid[sensor].t_offered = t
        elif not due(s, prm, sensor, w, f):
            i = -1
        if i >= 0:
            m = s.ring[sensor if sensor < N_QUEUED else 0, i]
            resting = s.rest.still == 1 and s.rest.moved == 0
            if of_the_air(sensor):
                fuse_offer(s, aids, t, sensor, air_offer(s, prm, sensor, m))
                if sensor >= N_QUEUED:
                    sensor += 1
                continue
            offer = offer_of(s, prm, sensor, m, aids, dt, w, resting, stage)
            yaw, bias = s.yaw_corrected, 0.0
            if sensor == MAGNETOMETER:
                bias = compass.vertical_bias(s)
            fused = s.aid[sensor].n_fused
            fuse_offer(s, aids, t, sensor, offer)
            if sensor == MAGNETOMETER:
                compass.attribute(s, yaw, bias)
            if stage is not None and sensor == GNSS_VELOCITY and s.aid[sensor].n_fused > fused:
                first_stage.fuse_velocity(stage[0], prm, m)
        if i < 0 or sensor >= N_QUEUED:  # a queue is emptied before the next sensor
            sensor += 1
    wake = s.aid[N_QUEUED].t_due
    for k in range(N_SENSORS):
        if k >= N_QUEUED:
            wake = min(wake, s.aid[k].t_due)
        elif s.ring_n[k] > 0:
            wake = min(wake, s.ring[k, s.ring_head[k]].t)
    s.t_wake = wake
