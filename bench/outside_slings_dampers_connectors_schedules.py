"""Twelve effects: cables and hanging loads, structures, propulsion and power, flight-control
software."""

from __future__ import annotations

import math

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
INERTIA = 0.012
"""kg m², roll or pitch, of a 1.2 kg quadrotor."""


# ---------------------------------------------------------------- cables, tethers, slings,
# hanging loads


class SlungLoad:
    """A small load on a sling whose hook sits below the centre of gravity, in free flight.

    The load is a pendulum driven by the hook's horizontal acceleration; the aircraft's own
    horizontal
    acceleration follows its tilt, less drag:
        v' = g tan(th) - d v,   a_h = v' - h th''
        L ph'' = a_h cos(ph) - g sin(ph) - c L ph'
        T = m (g cos(ph) + L ph'^2 + a_h sin(ph)),   torque = -h T sin(th - ph) / I
    (ph: angle of the sling from the vertical; T: tension, with the centrifugal term.)
    Source: Bisgaard, "Modeling, Estimation and Control of Helicopter Slung Load System" (2008),
    ch. 3;
    Stevens & Lewis for the carrier. Felt because 0.1 kg at 8 cm below the centre of gravity pulls
    with several rad/s² per rad, and the sling lags behind a tilt by its swing of about half a
    second.
    """

    def __init__(self, strength: float) -> None:
        self.mass, self.hook, self.length = 0.10 * strength, 0.09, 0.55
        self.swing = self.swing_rate = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        th = float(s.angle[i])
        vdot = G * math.tan(max(-0.9, min(0.9, th))) - 0.5 * self.v
        self.v += dt * vdot
        ah = vdot - self.hook * float(s.acceleration[i])
        sp, cp = math.sin(self.swing), math.cos(self.swing)
        self.swing_rate += dt * ((ah * cp - G * sp) / self.length - 0.5 * self.swing_rate)
        self.swing += dt * self.swing_rate
        tension = self.mass * max(
            0.0, G * cp + self.length * self.swing_rate * self.swing_rate + ah * sp)
        c.torque[i] = -self.hook * tension * math.sin(th - self.swing) / INERTIA
        return c


class Umbilical:
    """The power and data bundle of a test rig, bent back and forth by the rotation.

    Stranded cable: it bends elastically, stiffer as it straightens against its clamp, and its
    strands
    rub on each other, so that the bending moment has a rate-independent loop:
        torque = -(k (th - th0) + k3 (th - th0)^3) - M z,   dz = (dth - z |dth|) / e
    Source: Dahl's friction model (1968) = Bouc-Wen with n = 1; Papailiou, "On the bending
    stiffness of
    transmission line conductors" (IEEE Trans. Power Delivery, 1997). Felt on every rig with a
    thick
    cable: a moment of some hundredth Nm on 0.012 kg m² is about 1 rad/s².
    """

    def __init__(self, strength: float) -> None:
        self.k, self.k3, self.loop = 1.6 * strength, 30.0 * strength, 0.95 * strength
        self.z, self.rest = 0.0, 0.05

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        moved = float(s.rate[i]) * s.dt
        side = 1.0 if moved > 0.0 else -1.0
        self.z = side + (self.z - side) * math.exp(-abs(moved) / 0.035)
        bend = float(s.angle[i]) - self.rest
        c.torque[i] = -(self.k + self.k3 * bend * bend) * bend - self.loop * self.z
        return c


class SafetyLines:
    """Two slack safety cords of a rig, one on each side: each pulls only when its slack is used
    up.

    The slacks differ. A taut braided cord stiffens with stretch and loses energy within:
        torque = -k d^1.3 (1 + l d'),  d = th - slack > 0, never pushing; likewise on the other
        side
    Source: the contact law of Hunt & Crossley (1975; damping as in Lankarani & Nikravesh 1990),
    here for a
    cord in tension; stiffening of ropes with load, Feyrer, "Wire Ropes" (2007). Felt because
    references of ±0.2 rad run
    into cords that go taut at a tenth of a rad.
    """

    def __init__(self, strength: float) -> None:
        self.k = 55.0 * strength
        self.slack_up, self.slack_down = 0.09, 0.12

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        th, w = float(s.angle[i]), float(s.rate[i])
        if th > self.slack_up:
            c.torque[i] = -self.k * (th - self.slack_up) ** 1.3 * max(0.0, 1.0 + 0.35 * w)
        elif th < -self.slack_down:
            c.torque[i] = self.k * (-th - self.slack_down) ** 1.3 * max(0.0, 1.0 - 0.35 * w)
        return c


# ---------------------------------------------------------------- structures and fasteners


class GelMount:
    """The autopilot sits on soft gel pads that let it rock about the frame: its gyro rocks with
    it.

        q'' = -th'' - 2 z w q' - w^2 q (1 + (q/q0)^2),   gyro shows th' + q'
    (q: rocking of the box against the frame; the pads stiffen as they are squeezed.)
    Source: Harris' "Shock and Vibration Handbook", vibration isolation with a hardening (Duffing)
    mount; base-excited oscillator in Den Hartog. Felt because heavy boxes on over-soft pads have
    their resonance at 8 to 10 Hz, just above the motors' bandwidth.
    """

    def __init__(self, strength: float) -> None:
        w = 2.0 * math.pi * 8.0
        self.w2 = w * w / strength
        self.damp = 2.0 * 0.16 * w / math.sqrt(strength)
        self.q = self.qd = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        soft = self.q / 0.010
        self.qd = (self.qd - dt * (float(s.acceleration[i])
                                   + self.w2 * self.q * (1.0 + soft * soft))) / (1.0 + dt * self.damp)
        self.q += dt * self.qd
        c.gyro[i] = self.qd
        return c


class LooseBattery:
    """A battery on the top plate, held by a worn strap, slides sideways on a rig that tilts it.

    Strap spring, dry friction under the strap, and the rails at the ends of its play:
        x'' = g sin(th) - h th'' - w^2 x - c x' - mu g tanh(x'/vs) - stops(x)
        torque = m (g x cos(th) - h x'') / I
    Source: Lagrange's equations of a mass sliding on a rocking plate (Goldstein; Meirovitch);
    regularised Coulomb friction after Armstrong-Hélouvry. Felt because 0.25 kg displaced by 5 mm
    are 1 rad/s², and it arrives late and with a jerk.
    """

    def __init__(self, strength: float) -> None:
        self.mass, self.h, self.w2, self.gap = 0.25 * strength, 0.04, 190.0, 0.0075
        self.x = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        th = float(s.angle[i])
        x, v = self.x, self.v
        a = (G * math.sin(th) - self.h * float(s.acceleration[i]) - self.w2 * x - 3.0 * v
             - 0.06 * G * math.tanh(v / 0.004))
        if x > self.gap:
            a -= max(0.0, 12000.0 * (x - self.gap) + 60.0 * v)
        elif x < -self.gap:
            a -= min(0.0, 12000.0 * (x + self.gap) + 60.0 * v)
        self.v = v + dt * a
        self.x = x + dt * self.v
        c.torque[i] = self.mass * (G * x * math.cos(th) - self.h * a) / INERTIA
        return c


class OilDamper:
    """A rig's oil damper (dashpot) on a lever, with rubber eyes at its ends.

    The oil's resistance is laminar plus turbulent (orifice) and weaker in rebound than in
    compression,
    and the rubber eyes are in series with it, so that the damper relaxes rather than damps at
    once:
        F = k (th - y) = c1 y' + c2 y'|y'|  (times 0.55 when y' < 0),   torque = -F
    Source: Dixon, "The Shock Absorber Handbook" (2007), ch. 5-6 (linear plus square law,
    asymmetry,
    bush stiffness); Maxwell element in Lakes, "Viscoelastic Materials". Felt because such dampers
    are put on rigs to calm them and give some rad/s² at 1 rad/s.
    """

    def __init__(self, strength: float) -> None:
        self.k, self.c1, self.c2 = 18.0 * strength, 2.2 * strength, 5.0 * strength
        self.y = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        force = self.k * (float(s.angle[i]) - self.y)
        share = 1.0 if force > 0.0 else 0.55
        f = abs(force) / share
        flow = (math.sqrt(self.c1 * self.c1 + 4.0 * self.c2 * f) - self.c1) / (2.0 * self.c2)
        self.y += s.dt * math.copysign(flow, force)
        c.torque[i] = -force
        return c


# ---------------------------------------------------------------- propulsion and power


class CoastingMotors:
    """Speed controllers that drive the propeller up but let it coast down.

    Without active braking only the propeller's drag slows the rotor; J W' = -kq W^2 has the time
    constant J/(2 kq W), longer the slower it turns; upwards the motor's back-EMF adds its damping:
        lag / lag0 = 1 + 0.9 a sqrt(0.5/speed) * coasting,  coasting = 1/2 - 1/2 tanh((command -
        speed)/0.008)
    Source: motor equation in Mahony, Kumar & Corke, "Multirotor Aerial Vehicles" (IEEE RAM
    2012) and
    in Franchi & Mallet, "Adaptive closed-loop speed control of BLDC motors" (ICRA 2017). Felt with
    every controller whose 'damped light' is off: half of the torque comes from the falling motors.
    """

    def __init__(self, strength: float) -> None:
        self.a = 0.9 * strength

    def step(self, s: Situation) -> Change:
        c = Change()
        a = self.a
        c.lag = np.array([
            1.0 + a * math.sqrt(0.5 / max(0.1, v)) * (0.5 - 0.5 * math.tanh((u - v) / 0.008))
            for u, v in zip(s.command.tolist(), s.speed.tolist())
        ])
        return c


class HotConnector:
    """A worn bullet connector in the lead of one motor (the first): it drops volts and heats up.

    Current follows thrust^1.5, the lost voltage takes speed and thus thrust, and the contact's
    resistance rises with its own heat within seconds and cools again:
        f = (1 - R I / V)^2,  I = I0 (speed/0.5)^1.5,  R = R0 (1 + al H),  tau H' =
        (R/R0)(I/I0)^2 - H
    Source: Hughes & Drury, "Electric Motors and Drives" (speed against armature voltage); Holm,
    "Electric Contacts" (contact resistance and temperature); momentum theory, Leishman ch. 2, for
    the power 1.5. Felt because a few per cent of a motor's thrust are several rad/s², and the loss
    grows faster than the thrust, so that each throttle or roll command unbalances the aircraft
    anew.
    """

    def __init__(self, strength: float) -> None:
        self.drop = 0.17 * strength
        """V at hover, cold."""
        self.heat = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        current = (max(0.02, float(s.speed[0])) / 0.5) ** 1.5
        r = 1.0 + 0.25 * self.heat
        self.heat += s.dt / 5.0 * (r * current * current - self.heat)
        self.heat = min(self.heat, 3.0)
        left = max(0.3, 1.0 - self.drop * r * current / s.battery_v)
        c.thrust = np.array([left * left, 1.0, 1.0, 1.0])
        return c


class TranslationMoment:
    """Propellers in sideways flight: the blades' flapping and the front propellers' wake pitch
    it back.

    A tilt accelerates the aircraft sideways; the advancing blades lift more and the discs tilt
    back,
    while the rear propellers work in the wake of the front ones; both need time to build up
    inflow:
        v' = g tan(th) T/T0 - d1 v - d2 v|v|
        wanted = -(k1 W/W0 v + k2 v|v| / (1 + (v/vh)^2)),   tau m' = wanted - m
    Source: Hoffmann, Huang, Waslander & Tomlin, "Quadrotor Helicopter Flight Dynamics and Control"
    (AIAA 2007); Leishman, "Principles of Helicopter Aerodynamics", ch. 4 and 10. Felt in every
    free
    flight of a light quadrotor: at 1 m/s it takes about 1 rad/s² to hold the tilt.
    """

    def __init__(self, strength: float) -> None:
        self.k1, self.k2 = 0.75 * strength, 0.35 * strength
        self.v = self.m = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        lift = 2.0 * s.throttle
        v = self.v
        self.v = v + dt * (G * math.tan(max(-0.9, min(0.9, float(s.angle[i])))) * lift
                           - 0.35 * v - 0.12 * v * abs(v))
        wanted = -(self.k1 * math.sqrt(max(0.0, lift)) * v
                   + self.k2 * v * abs(v) / (1.0 + v * v / 9.0))
        self.m += dt / 0.08 * (wanted - self.m)
        c.torque[i] = self.m
        return c


# ---------------------------------------------------------------- flight-control software


class SlewLimit:
    """The output stage limits how fast a motor command may change, upwards tighter than downwards.

        out += clip(command - out, -down dt, +up dt)
    Source: rate limiter, Franklin, Powell & Emami-Naeini, "Feedback Control of Dynamic
    Systems", and
    ArduPilot's MOT_SLEW_UP_TIME / MOT_SLEW_DN_TIME. It protects controllers and propellers; felt
    because a step of the reference asks for a tenth of the range within one cycle.
    """

    def __init__(self, strength: float) -> None:
        self.up, self.down = 1.5 / strength, 2.0 / strength
        self.out = None

    def step(self, s: Situation) -> Change:
        c = Change()
        new = s.command.tolist()
        if self.out is not None:
            up, down = self.up * s.dt, self.down * s.dt
            new = [o + max(-down, min(up, u - o)) for u, o in zip(new, self.out)]
        self.out = new
        c.command = np.array(new)
        return c


class ThrottleNotch:
    """A gyro notch that is meant for the propellers' vibration but set too low and too wide.

    Its centre follows the throttle (the speed of the propellers is its square root), so that its
    lag in the pass band changes with the throttle:
        H(p) = (p^2 + w0^2) / (p^2 + w0 p/Q + w0^2),   w0 = 2 pi 15 Hz sqrt(throttle/0.5)
    as a trapezoidal state-variable filter, all three axes.
    Source: Zavalishin, "The Art of VA Filter Design" (2012), ch. 4; Betaflight / ArduPilot
    (INS_HNTCH_*) throttle-based harmonic notch. Felt because its phase at 2 Hz is some 10 degrees.
    """

    def __init__(self, strength: float) -> None:
        self.width = 1.3 * strength
        self.state = [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
        self.throttle = 0.5

    def step(self, s: Situation) -> Change:
        c = Change()
        self.throttle += s.dt / 0.1 * (s.throttle - self.throttle)
        g = math.tan(math.pi * 15.0 * math.sqrt(max(0.1, self.throttle) / 0.5) * s.dt)
        k = self.width
        a1 = 1.0 / (1.0 + g * (g + k))
        a2 = g * a1
        a3 = g * a2
        shift = []
        for x, st in zip(s.rate.tolist(), self.state):
            b, low = st
            d = x - low
            v1 = a1 * b + a2 * d
            v2 = low + a2 * b + a3 * d
            st[0] = 2.0 * v1 - b
            st[1] = 2.0 * v2 - low
            shift.append(-k * v1)
        c.gyro = np.array(shift)
        return c


class GainSchedule:
    """Gains scheduled on throttle in the mixer: less authority the more throttle, and a late
    boost.

    The roll and pitch parts of the commands are scaled by a curve of the throttle, filtered, and
    raised while the throttle moves quickly:
        g = 1 - a tanh((Thr_f - 0.51)/0.06) + b |Thr - Thr_f|,   tau Thr_f' = Thr - Thr_f
        command = Thr + g (roll and pitch part) + (yaw part)
    Source: gain scheduling, Åström & Wittenmark, "Adaptive Control", ch. 9; Betaflight's
    throttle PID
    attenuation and anti-gravity. Felt because the loop's gain differs by a factor between a slow
    descent and a climb.
    """

    def __init__(self, strength: float) -> None:
        self.a, self.b = 0.33 * strength, 3.0 * strength
        self.slow = 0.5

    def step(self, s: Situation) -> Change:
        c = Change()
        thr = s.throttle
        self.slow += s.dt / 0.35 * (thr - self.slow)
        g = 1.0 - self.a * math.tanh((self.slow - 0.51) / 0.06) + self.b * abs(thr - self.slow)
        m0, m1, m2, m3 = s.command.tolist()
        roll = g * 0.25 * (m0 - m1 + m2 - m3)
        pitch = g * 0.25 * (m0 - m1 - m2 + m3)
        yaw = 0.25 * (m0 + m1 - m2 - m3)
        c.command = np.array([
            min(1.0, max(0.0, thr + roll + pitch + yaw)),
            min(1.0, max(0.0, thr - roll - pitch + yaw)),
            min(1.0, max(0.0, thr + roll - pitch - yaw)),
            min(1.0, max(0.0, thr - roll + pitch - yaw)),
        ])
        return c


EFFECTS = {
    'slung_load_again': (SlungLoad, False),
    'umbilical': (Umbilical, True),
    'safety_lines': (SafetyLines, True),
    'gel_mount_again': (GelMount, False),
    'loose_battery_again': (LooseBattery, True),
    'oil_damper': (OilDamper, True),
    'coasting_motors': (CoastingMotors, False),
    'hot_connector': (HotConnector, False),
    'translation_moment': (TranslationMoment, False),
    'uneven_slew_limit': (SlewLimit, True),
    'throttle_notch': (ThrottleNotch, True),
    'gain_schedule': (GainSchedule, False),
}
FAMILIES = {
    'cables': ('slung_load_again', 'umbilical', 'safety_lines'),
    'structures': ('gel_mount_again', 'loose_battery_again', 'oil_damper'),
    'propulsion': ('coasting_motors', 'hot_connector', 'translation_moment'),
    'software': ('uneven_slew_limit', 'throttle_notch', 'gain_schedule'),
}

MAY_BE = {
    'slung_load_again': ('pendulum_stiffness', 'resonance'),
    'umbilical': ('pendulum_stiffness', 'cubic_stiffness', 'coulomb_friction'),
    'safety_lines': ('cubic_stiffness', 'pendulum_stiffness'),
    'gel_mount_again': ('resonance', 'cubic_stiffness'),
    'loose_battery_again': ('pendulum_stiffness', 'coulomb_friction', 'resonance', 'cubic_stiffness'),
    'oil_damper': ('quadratic_drag', 'pendulum_stiffness'),
    'coasting_motors': ('motor_lag',),
    'hot_connector': ('cross_axis_input', 'battery_sag'),
    'uneven_slew_limit': ('motor_lag', 'saturation'),
    'gain_schedule': ('saturation',),
}
