"""Twelve physical effects, three in each of four families: tribology of the pivot, motors and
ESCs, aerodynamics, sensing.

All are deterministic and continuous; `strength` scales each of them linearly about 'no effect'
(for ESC effects: the coefficient that measures the departure from the ideal drive).
"""

from __future__ import annotations

import math

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
LAG_S = 0.042
ARM_SIGN = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0))
"""Side of each rotor about roll and pitch: thrust of a rotor with +1 turns the axis positively,
and a positive rate lifts it.
"""


# ---------------------------------------------------------------------- tribology
class ThrustRelievedBushing:
    """Plain bushing of the rig's pivot, whose radial load is the weight less the rotors' lift
    (load-scaled LuGre).

    The pin carries N = |weight - lift| (made of both components: what hangs vertically and a
    little belt/side load that never vanishes), so friction is large at low throttle and small
    when the rotors nearly carry the aircraft:
        N = sqrt((1 - T cos(theta)/T_w)^2 + n0^2),  T_w = 0.68 (aircraft with gimbal frame)
        g(w) = mu_c + (mu_s - mu_c) exp(-(w/w_s)^2)                      (Stribeck)
        dz/dt = w - sigma0 |w| z / g(w),   torque = -N (sigma0 z + sigma1 dz/dt)
    Sources: Canudas de Wit, Olsson, Astrom, Lischinsky, 'A new model for control of systems with
    friction', IEEE TAC 40 (1995); load scaling as in Canudas de Wit & Tsiotras (1999), tyre
    LuGre; Bowden & Tabor for friction ~ load.
    Felt: one-axis rigs hang in printed or bronze bushings; breakaway of some 1 rad/s2 against a
    drive of 5.
    """

    def __init__(self, strength):
        self.k = strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        a, b, c, d = s.speed.tolist()
        lift = 0.25 * (a + b + c + d) * math.cos(float(s.angle[s.axis]))
        x = 1.0 - lift / 0.68
        load = math.sqrt(x * x + 0.0025)
        g = 3.6 + 2.0 * math.exp(-(w / 0.06) ** 2)
        sigma0, sigma1 = 1000.0, 18.0
        # exact step of dz/dt = w - r z for constant w
        r = sigma0 * abs(w) / g
        before = self.z
        e = math.exp(-r * s.dt)
        self.z = before * e + (w * (1.0 - e) / r if r > 1e-9 else w * s.dt)
        slope = (self.z - before) / s.dt
        out = Change()
        out.torque[s.axis] = -self.k * load * (sigma0 * self.z + sigma1 * slope)
        return out


class ThixotropicGrease:
    """Greased ball bearings of the gimbal: Palmgren's speed law with grease that thins while it
    is worked.

        M = M0 (f + (1 - f) lam) |w|^(2/3) sign(w) + M1 tanh(w/w1)       (load-independent +
        load-dependent part)
        dlam/dt = (1 - lam)/T - k |w| lam                               (structure: rebuilds at
        rest, breaks by shear)
    Sources: Palmgren, 'Ball and Roller Bearing Engineering' (1959): M0 = 1e-7 f0 (nu n)^(2/3)
    d^3, M1 = f1 P d; structure kinetics: Moore (1959), Barnes, 'Thixotropy - a review', J.
    Non-Newtonian Fluid Mech. 70 (1997); Lugt, 'Grease Lubrication in Rolling Bearings' (2013).
    Felt: sealed bearings filled with NLGI 2 grease are stiff after a pause and loosen within
    seconds of motion.
    """

    def __init__(self, strength):
        self.k = strength
        self.lam = 1.0

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        self.lam += s.dt * ((1.0 - self.lam) / 2.5 - 1.8 * abs(w) * self.lam)
        power = w / (w * w + 2.5e-4) ** (1.0 / 6.0)
        out = Change()
        out.torque[s.axis] = -self.k * (3.0 * (0.25 + 0.75 * self.lam) * power + 0.15 * math.tanh(w / 0.04))
        return out


class CableHarnessHysteresis:
    """Supply and data cables led across the gimbal: they bend elastically, stiffen, and rub
    strand on strand (Bouc-Wen).

        torque = -[k (theta - th0) + k3 (theta - th0)^3 + alpha z]
        dz/dt = w - beta |w| |z|^(n-1) z - gamma w |z|^n,   n = 1.3,  z saturates at about 0.07
        rad
    Sources: Wen, 'Method for random vibration of hysteretic systems', ASCE J. Eng. Mech. 102
    (1976); Ikhouane & Rodellar, 'Systems with Hysteresis' (2007); for gimbals: cable torque in
    Masten, 'Inertially stabilized platforms' (IEEE CSM 2008).
    Felt: the tether of a test rig is the largest parasitic torque about the axis besides
    friction, with its rest position off centre and a loop of torque over angle even when moved
    slowly.
    """

    def __init__(self, strength):
        self.k = strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        x = float(s.angle[s.axis]) - 0.04
        z = self.z
        m = abs(z) ** 0.3
        self.z = z + s.dt * (w - 18.0 * abs(w) * m * z - 12.0 * w * m * abs(z))
        out = Change()
        out.torque[s.axis] = -self.k * (3.0 * x + 35.0 * x * x * x + 13.0 * self.z)
        return out


# ---------------------------------------------------------------------- motors and ESCs
class CoastingWithoutBrake:
    """ESC without complementary PWM: it can push current into the motor but not draw it out, so
    rotors slow down lazily.

    With diodes blocking the reverse current, a low-inductance motor at 8 kHz PWM sits at hover
    near the border of discontinuous conduction. Above it the winding brakes and drives alike
    (1/tau = KtKe/(RJ) + 2 kQ W/J); below it current stops in a part of each period, the
    electrical damping goes, and the propeller's torque alone slows the rotor. Load current, hence
    the border, moves with thrust n = s/0.5:
        lag factor = [1 + a (1 - tanh((u - s + x0 (n - 1))/x1))/2] / (1 + b (sqrt(n) - 1))
        a = 1.3 strength, b = 0.5 strength, x0 = 0.05, x1 = 0.008
    Sources: Mohan, Undeland & Robbins, 'Power Electronics', ch. 7 (discontinuous conduction);
    Bangura & Mahony, 'Thrust control for multirotor aerial vehicles', IEEE T-RO 33 (2017) for the
    rotor equation; 'damped light' in BLHeli manuals.
    Felt: everyday with cheap ESCs: crisp when rotors spin up or carry much load, sluggish when
    they spin down or idle low.
    """

    def __init__(self, strength):
        self.k = strength

    def step(self, s: Situation) -> Change:
        lag = []
        k = self.k
        for u, v in zip(s.command.tolist(), s.speed.tolist()):
            n = 2.0 * v if v > 0.05 else 0.1
            coast = 0.5 - 0.5 * math.tanh((u - v + 0.05 * (n - 1.0)) / 0.008)
            lag.append((1.0 + 1.3 * k * coast) / (1.0 + 0.5 * k * (math.sqrt(n) - 1.0)))
        return Change(lag=np.array(lag))


class SpeedGovernorEsc:
    """ESC in governor (closed-loop RPM) mode: a PI loop around each motor, with its current
    limit.

        e = u - s,   dx/dt = Ki e - (c_wanted - c)/T_aw,   c_wanted = u + Kp e + x,   c = s +
        d_max tanh((c_wanted - s)/d_max)
    around tau ds/dt = c - s; Ki = 14/s and Kp = 0.4 times strength, d_max = 0.05, T_aw = 0.05 s.
    Two poles, wn = sqrt(Ki/tau) = 18 rad/s with damping (1 + Kp)/(2 tau wn) = 0.9, and the PI's
    zero overshoot after each change of command; the current limit (d_max, excess voltage over
    back-EMF) makes it depend on the step's size and back-calculation stops windup.
    Sources: Astrom & Hagglund, 'Advanced PID Control' (2006), ch. 3 (back-calculation); Krishnan,
    'Permanent Magnet Synchronous and Brushless DC Motor Drives' (speed loops); governor mode of
    BLHeli_32 / Castle / APD ESCs.
    Felt: rotor thrust, hence torque, overshoots at some 3 Hz, within the attitude loop's band,
    and less so for large steps.
    """

    def __init__(self, strength):
        self.k = strength
        self.x = [0.0, 0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        out = []
        ki, x, dt = 14.0 * self.k, self.x, s.dt
        i = 0
        for u, v in zip(s.command.tolist(), s.speed.tolist()):
            e = u - v
            want = e + 0.4 * self.k * e + x[i]
            got = 0.05 * math.tanh(want / 0.05)
            x[i] += dt * (ki * e - (want - got) / 0.05)
            c = v + got
            out.append(0.0 if c < 0.0 else min(c, 1.0))
            i += 1
        return Change(command=np.array(out))


class DutySquaredOnSaggingPack:
    """ESCs take the command as duty cycle: thrust goes with the square of duty times loaded
    voltage (Thevenin pack).

        I = I_h mean((s/0.5)^1.5),   V = V_oc - R0 I - v_p,   dv_p/dt = (Rp I - v_p)/T_p
        u' = u + a [2 u^2 (V/V_h)^2 - (2 u - 0.5)],   a = 0.9 strength
    (the bracket is the square law less its tangent in hover, for which the firmware's linear
    mixer was scaled). Current ~ power ~ thrust^1.5 (momentum theory). The gain of the axis rises
    with throttle at once and droops over the next second as the pack polarises.
    Sources: Plett, 'Battery Management Systems' vol. 1 (2015), Thevenin cell; Leishman,
    'Principles of Helicopter Aerodynamics' ch. 2; thrust-curve exponent MOT_THST_EXPO in
    ArduPilot documentation.
    Felt: the best known reason why gains tuned at hover are wrong at other throttle.
    """

    def __init__(self, strength):
        self.k = strength
        self.vp = 0.55

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        current = 22.0 * 0.25 * 2.8284271 * (
            max(a, 0.0) ** 1.5 + max(b, 0.0) ** 1.5 + max(c, 0.0) ** 1.5 + max(d, 0.0) ** 1.5)
        self.vp += s.dt * (0.025 * current - self.vp) / 1.2
        v = (s.battery_v - 0.03 * current - self.vp) / 10.8
        share, gain = 0.9 * self.k, 2.0 * v * v
        out = []
        for u in s.command.tolist():
            u = u + share * (u * u * gain - 2.0 * u + 0.5)
            out.append(0.0 if u < 0.0 else min(u, 1.0))
        return Change(command=np.array(out))


# ---------------------------------------------------------------------- aerodynamics
class DynamicInflow:
    """The air under a rotor must first be set in motion: thrust overshoots a change of speed, and
    falls when the rotor rises.

    Blade element: T ~ W^2 (theta/3 - lambda/2), so against the steady state
        T/T_qs = 1 + kappa [(v_qs - v) - l_i w]/v_qs,   v_qs = v_h sqrt(s/0.5)
        dv/dt = (v_qs^2 - v^2)/(2 v_h T_v)         (apparent mass of air, momentum theory;
        nonlinear in v)
    with v_h = 6 m/s, arm l = 0.1 m, T_v = 0.07 s, kappa = 0.45 strength.
    Sources: Carpenter & Fridovich, NACA TN 3044 (1953); Pitt & Peters, Vertica 5 (1981); Leishman
    ch. 10; rotor damping by axial speed: Padfield, 'Helicopter Flight Dynamics' ch. 2.
    Felt: the torque of quick control moves is larger than static thrust tests tell, that of
    lasting ones is not.
    """

    def __init__(self, strength):
        self.k = strength
        self.v = [6.0, 6.0, 6.0, 6.0]

    def step(self, s: Situation) -> Change:
        roll, pitch = float(s.rate[0]), float(s.rate[1])
        factor, v, k, dt = [], self.v, 0.45 * self.k, s.dt
        i = 0
        for speed in s.speed.tolist():
            steady = 6.0 * math.sqrt(2.0 * speed if speed > 0.05 else 0.1)
            w = v[i]
            climb = 0.1 * (ARM_SIGN[0][i] * roll + ARM_SIGN[1][i] * pitch)
            factor.append(1.0 + k * (steady - w - climb) / steady)
            v[i] = w + dt * (steady * steady - w * w) / (2.0 * 6.0 * 0.07)
            i += 1
        return Change(thrust=np.array(factor))


class FlapBackByTranslation:
    """A tilted aircraft slides off sideways, and the rotors in crosswind flap back and tilt it
    against its motion.

        dv/dt = g (T/0.5) sin(theta) - D v sqrt(T/0.5)          (rotor drag ~ v times rotor speed)
        torque = -[c1 v sqrt(T/0.5) + c2 v |v|]                 (flap-back a1 = 2 mu (4/3 theta -
        lambda); hull above c.g.)
    Sources: Mahony, Kumar & Corke, 'Multirotor aerial vehicles', IEEE RAM 19 (2012); Hoffmann,
    Huang, Waslander & Tomlin, AIAA 2007-6461; Bramwell, 'Helicopter Dynamics' (speed stability
    M_u).
    Felt: in any free flight; the known phugoid-like 'M_u' derivative, which a model of attitude
    alone has no state for.
    """

    def __init__(self, strength):
        self.k = strength
        self.v = 0.0

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        lift = 0.5 * (a + b + c + d)
        root = math.sqrt(max(0.0, lift))
        v = self.v
        self.v = v + s.dt * (G * lift * math.sin(float(s.angle[s.axis])) - 0.5 * root * v)
        out = Change()
        out.torque[s.axis] = -self.k * (0.75 * v * root + 0.2 * v * abs(v))
        return out


class GuardDragInOwnWake:
    """Propeller guards and arms beat the air as they turn: quadratic drag on the motion relative
    to air they have dragged along.

        d = w - w_air,   dw_air/dt = (w - w_air)/T_w,   T_w = 0.3 s
        torque = -c d sqrt(d^2 + w_s^2),   w_s = 0.25 sqrt(T/0.5)
    (normal force ~ normal speed times total speed: the slipstream's speed along the plates adds
    to it, in rad/s at the guards' radius.) Returning before the wake has decayed meets air coming
    the other way.
    Sources: Hoerner, 'Fluid-Dynamic Drag' ch. 3 (cross-flow principle); Sarpkaya & Isaacson,
    'Mechanics of Wave Forces on Offshore Structures' (wake encounter of oscillating bodies).
    Felt: with shrouds or foam guards on a light frame, rates of 1-2 rad/s meet several rad/s2 of
    drag.
    """

    def __init__(self, strength):
        self.k = strength
        self.air = 0.0

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        w = float(s.rate[s.axis])
        r = w - self.air
        self.air += s.dt * r / 0.3
        stream = 0.0625 * max(0.5 * (a + b + c + d), 0.0)
        out = Change()
        out.torque[s.axis] = -self.k * 4.2 * r * math.sqrt(r * r + stream)
        return out


# ---------------------------------------------------------------------- sensing
class VibrationRectification:
    """MEMS gyro turns vibration into bias: as a rotor's speed nears the frame's resonance, the
    zero of the gyro wanders.

        A_i^2 = r^4/((1 - r^2)^2 + (2 zeta r)^2),   r^2 = s_i/0.64 (rotor speed squared over
        resonance squared)
        bias = k sum(m_i A_i^2) - (its value in hover), through the 0.08 s of the sensor's and the
        structure's response
    m_i are the rotors' unequal imbalances. Rectification goes with the square of the amplitude.
    Sources: Den Hartog, 'Mechanical Vibrations' (rotating imbalance); IEEE Std 1431 (Coriolis
    gyros, vibration rectification); application notes of MEMS makers on vibration rectification.
    Felt: gyros on a stiff plate shaken by unbalanced propellers show offsets of several degrees
    per second with throttle.
    """

    def __init__(self, strength):
        self.k = strength
        self.y = 0.0

    def step(self, s: Situation) -> Change:
        total = -6.75
        for m, v in zip((0.42, 0.20, 0.28, 0.10), s.speed.tolist()):
            q = v / 0.64
            total += m * q * q / ((1.0 - q) ** 2 + 0.0784 * q)
        self.y += s.dt * (total - self.y) / 0.08
        out = Change()
        out.gyro[s.axis] = 0.035 * self.k * self.y
        return out


class SkewedDroopingBoard:
    """Flight controller stuck on askew, on pads that yield under the load of thrust: other axes'
    rates enter this one.

        shown = Rx(phi)Ry(theta) Rz(psi) rate,   psi = 0.26 rad fixed,  d(theta)/dt = (0.16 T/0.5
        - theta)/T_creep, T_creep 0.4 s
    The skew psi mixes roll and pitch, the droop mixes yaw into roll (theta) and into pitch (phi =
    0.6 theta), more at more throttle; and cosines lose a few percent of the own axis.
    Sources: Titterton & Weston, 'Strapdown Inertial Navigation Technology' (misalignment, ch.
    8-12); standard linear solid (creep) in Lakes, 'Viscoelastic Materials'.
    Felt: a board turned by 15 degrees and standing on soft double-sided tape; everyday in hobby
    and laboratory builds.
    """

    def __init__(self, strength):
        self.k = strength
        self.tilt = 0.16
        self.c, self.d = math.cos(0.26 * strength), math.sin(0.26 * strength)

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        self.tilt += s.dt * (0.08 * (a + b + c + d) - self.tilt) / 0.4
        p, q, r = s.rate.tolist()
        x, y = self.c * p + self.d * q, self.c * q - self.d * p
        e = self.k * self.tilt
        f = 0.6 * e
        ce, se, cf, sf = math.cos(e), math.sin(e), math.cos(f), math.sin(f)
        x, z = ce * x - se * r, ce * r + se * x
        y, z = cf * y + sf * z, cf * z - sf * y
        return Change(gyro=np.array((x - p, y - q, z - r)))


class FalseVerticalOfAhrs:
    """The rate comes bias-corrected from an attitude filter, whose accelerometer cannot see tilt
    in coordinated flight.

    In flight the accelerometer feels thrust and drag only: dv/dt = g theta - D v gives it the
    apparent tilt D v/g instead of theta. The complementary (Mahony) filter pulls its estimate
    there and books it as gyro bias:
        e = D v/g - est,   dest/dt = w + Kp e + b,   db/dt = Ki e,   shown = w + Kp e + b
    with Kp = 0.8 and Ki = 0.3 times strength, e bounded as in code (0.4 tanh(e/0.4), distrust of
    large innovation).
    Sources: Mahony, Hamel & Pflimlin, 'Nonlinear complementary filters on SO(3)', IEEE TAC 53
    (2008); Martin & Salaun, 'The true role of accelerometer feedback in quadrotor control', ICRA
    2010.
    Felt: every low-cost IMU with on-chip fusion does it: rates read low while the aircraft is
    tilted.
    """

    def __init__(self, strength):
        self.k = strength
        self.v = self.est = self.b = 0.0

    def step(self, s: Situation) -> Change:
        w, dt = float(s.rate[s.axis]), s.dt
        self.v += dt * (G * math.sin(float(s.angle[s.axis])) - 0.4 * self.v)
        e = 0.4 * math.tanh((0.4 * self.v / G - self.est) / 0.4)
        self.b += dt * 0.3 * self.k * e
        error = 0.8 * self.k * e + self.b
        self.est += dt * (w + error)
        out = Change()
        out.gyro[s.axis] = error
        return out


EFFECTS = {
    'thrust_relieved_bushing': (ThrustRelievedBushing, True),
    'thixotropic_grease': (ThixotropicGrease, True),
    'cable_harness_hysteresis': (CableHarnessHysteresis, True),
    'coasting_without_brake': (CoastingWithoutBrake, True),
    'speed_governor_esc': (SpeedGovernorEsc, True),
    'duty_squared_on_sagging_pack': (DutySquaredOnSaggingPack, False),
    'dynamic_inflow': (DynamicInflow, False),
    'flap_back_by_translation': (FlapBackByTranslation, False),
    'guard_drag_in_own_wake': (GuardDragInOwnWake, True),
    'rectified_vibration': (VibrationRectification, True),
    'skewed_drooping_board': (SkewedDroopingBoard, False),
    'false_vertical_of_ahrs': (FalseVerticalOfAhrs, False),
}

FAMILIES = {
    'tribology of bearings and gimbals': (
        'thrust_relieved_bushing', 'thixotropic_grease', 'cable_harness_hysteresis',
    ),
    'motor control and ESCs': (
        'coasting_without_brake', 'speed_governor_esc', 'duty_squared_on_sagging_pack',
    ),
    'aerodynamics of propellers, arms and hull': (
        'dynamic_inflow', 'flap_back_by_translation', 'guard_drag_in_own_wake',
    ),
    'sensing': (
        'rectified_vibration', 'skewed_drooping_board', 'false_vertical_of_ahrs',
    ),
}
MAY_BE = {
    'thrust_relieved_bushing': ('coulomb_friction',),
    'cable_harness_hysteresis': ('coulomb_friction', 'pendulum_stiffness', 'cubic_stiffness'),
    'duty_squared_on_sagging_pack': ('thrust_curve', 'battery_sag'),
    'guard_drag_in_own_wake': ('quadratic_drag',),
    'skewed_drooping_board': ('cross_axis_input', 'gyroscopic_coupling'),
    'false_vertical_of_ahrs': ('pendulum_stiffness',),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
