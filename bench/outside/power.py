"""Batteries, wires and connectors: what the voltage does to the thrust."""

from __future__ import annotations

import math

import numpy as np

from .simulator import HOVER, SIDE, Change, Plant, Situation


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


class WeakBattery:
    """Old, cold pack: its voltage sinks under load, at once and by two polarisations.

    V = E - I R0 - V1 - V2, Vi' = (I Ri - Vi)/τi (Thevenin), I ~ Σ thrust^1.5; thrust factor
    (V/Vh)^1.8, Vh at hover, fresh. Plett, Battery Management Systems vol. 1, ch. 2; Podhradsky et
    al. 2014.
    Felt because every gain goes with the square of the voltage.
    """

    def __init__(self, strength):
        self.k, self.v1, self.v2 = strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i = 0.0
        for n in range(4):
            i += max(float(s.speed[n]), 0.0) ** 1.5
        i /= 4.0 * 0.35355
        k = self.k
        self.v1 += s.dt / 0.5 * (0.9 * k * i - self.v1)
        self.v2 += s.dt / 4.0 * (1.0 * k * i - self.v2)
        v = s.battery_v - 0.9 * k * i - self.v1 - self.v2
        c.thrust = np.full(4, (max(v, 6.0) / (12.6 - 2.6 * k)) ** 1.8)
        return c


class CorrodedPlug:
    """Bad plug in the harness of the two motors of one side; it heats itself.

    ΔV/V = r (1 + a ϑ) (I1 + I2), ϑ' = ((I1+I2)² (1 + a ϑ) - ϑ)/τ, I ~ thrust^1.5; their thrust
    factor (1 - ΔV/V)² + what was trimmed away in hover. Holm, Electric Contacts (1967),
    self-heating of a contact; Slade 2014.
    Felt because two per cent of a side's thrust are 2 rad/s².
    """

    def __init__(self, strength):
        self.k, self.hot = strength, 1.0

    def step(self, s: Situation) -> Change:
        c = Change()
        m, n = (i for i in range(4) if SIDE[s.axis][i] < 0.0)
        i = (max(float(s.speed[m]), 0.0) ** 1.5 + max(float(s.speed[n]), 0.0) ** 1.5) / 0.7071
        self.hot += s.dt / 2.0 * (i * i * (1.0 + 0.3 * (self.hot - 1.0)) - self.hot)
        drop = 0.011 * self.k * i * (1.0 + 0.6 * (self.hot - 1.0))
        f = (1.0 - drop) ** 2 + 1.0 - (1.0 - 0.011 * self.k) ** 2
        thrust = np.ones(4)
        thrust[m] = thrust[n] = f
        c.thrust = thrust
        return c


class SaggingPack:
    """An old, cold battery: its voltage sags under the motors' current, at once, more steeply
    near the limiting current, and late.

    Thevenin with two RC links, a concentration overvoltage and a resistance that falls as the
    cells warm:
        V = E − I·R0·exp(−(T − T0)/Tr) − v1 − v2 + A·ln(1 − I/Ilim),   vj' = (I·Rj − vj)/τj,   T'
        = (I²·R0·w − (T − T0))/τT,
    I = Σ u_i^1.5·(V/Vh)/n (power of the propellers; in units of the hover current), thrust ∝
    (V/Vh)² at given duty, and a motor that is to spin up has less voltage left, lag·(1 +
    c·sag·(spinning up)). So the control's gain falls with throttle and with what was drawn in the
    last seconds.
    Source: Plett, Battery Management Systems I (2015), ch. 2; Chen & Rincón-Mora, IEEE Trans.
    Energy Conv. 21 (2006) 504. An aged 3S pack of a quarter or more sag in hover is what pilots
    know from winter flights. Strength: the resistances.
    """

    def __init__(self, strength):
        self.r0 = 1.5 * strength
        self.r = (0.8 * strength, 0.7 * strength)
        self.a, self.limit = 1.4 * strength, 1.8
        self.v1 = self.v2 = 0.0
        self.warm = 0.0
        self.hover = 12.0 - 0.85 * self.r0 - sum(self.r) + self.a * math.log(1.0 - 1.0 / self.limit)
        self.ratio = 1.0

    def step(self, s: Situation) -> Change:
        u = s.speed.tolist()
        n = 4.0 * 0.5 ** 1.5
        x = sum([max(v, 0.0) ** 1.5 for v in u]) / n * self.ratio
        self.v1 += s.dt / 0.35 * (x * self.r[0] - self.v1)
        self.v2 += s.dt / 2.5 * (x * self.r[1] - self.v2)
        self.warm += s.dt / 6.0 * (0.16 * x * x - self.warm)
        volts = (s.battery_v - x * self.r0 * math.exp(-self.warm) - self.v1 - self.v2
                 + self.a * math.log(1.0 - min(x / self.limit, 0.95)))
        self.ratio = max(0.3, volts / self.hover)
        change = Change()
        f = self.ratio * self.ratio
        change.thrust = np.array((f, f, f, f))
        sag = max(0.0, (s.battery_v - volts) / s.battery_v)
        c = s.command.tolist()
        change.lag = np.array([1.0 + 1.2 * sag * (0.5 + 0.5 * math.tanh((a - b) / 0.02)) for a, b in zip(c, u)])
        return change


class CorrodedConnector:
    """One motor's plug is corroded: its contact resistance takes voltage from that motor alone,
    and grows as it heats.

        loss = 1 − (1 − I·Rc·(1 + α·ΔT)/V)²,   ΔT' = (I²·Rc·(1 + α·ΔT)·w − ΔT − (ΔT/Tk)²)/τ,   I ∝
        u^1.5,
    thrust of that motor times (1 − loss)/(1 − loss in hover) (the pilot has trimmed it out in
    hover). Throttle then rolls the aircraft, at once by the current and in the following seconds
    by the heating; that motor's gain is smaller too.
    Source: Holm, Electric Contacts (4th ed. 1967), §§ 11-14; Slade, Electrical Contacts (2014),
    ch. 1 and 7; thermal balance: Mohan, Undeland & Robbins, Power Electronics, ch. 29. A bullet
    plug of 15 mΩ, more when hot, at 15 A (2 to 3 % of the voltage) is a common fault. Strength:
    Rc.
    """

    BAD = 0

    def __init__(self, strength):
        self.r = 0.20 * strength
        self.alpha, self.w = 0.6, 3.8
        self.heat = 0.0
        for _ in range(300):
            self._warm(1.0, 0.05)
        self.hover = 1.0 - self._loss(1.0, 12.0)
        self.heat = 0.0

    def _warm(self, current, dt):
        h = self.heat
        self.heat = h + dt / 2.2 * (current * current * self.r * (1.0 + self.alpha * h) * self.w - h - (h / 1.2) ** 2)

    def _loss(self, current, volts):
        return 1.0 - (1.0 - current * self.r * (1.0 + self.alpha * self.heat) / volts) ** 2

    def step(self, s: Situation) -> Change:
        current = (max(0.0, float(s.speed[self.BAD])) / 0.5) ** 1.5
        self._warm(current, s.dt)
        change = Change()
        change.thrust = np.ones(4)
        change.thrust[self.BAD] = (1.0 - self._loss(current, s.battery_v)) / self.hover
        return change


class SaggingQuadratic:
    """Thrust goes with the square of duty times voltage, and the voltage sags behind the current.

    The makers of the simple model took thrust as linear in the command; the propeller starts at u0 and gives
        T_i ~ ((u_i - u0) V)²   ->   factor_i = (u_i - u0)² / (2 (0.5 - u0) u_i) (V/V0)²
    (scaled to the slope in hover, where the simple gain was measured),
        V = V_battery - R0 I - V1,   V1' = (R1 I - V1)/tau1,   I = I_max mean(u^1.5)
    with the leads' resistance and a cell pack's second (diffusion) branch. So the same difference of
    commands turns the aircraft more at high throttle, then, as the voltage sinks, less again.
    Sources: McCormick, Aerodynamics, Aeronautics and Flight Mechanics, ch. 6; Chen & Rincon-Mora, IEEE
    Trans. Energy Conv. 21 (2006) 504 (battery). Felt here: throttle 0.42 to 0.6 alone is 50 % of gain.
    Strength mixes between the linear thrust (0) and this one (1), and beyond.
    """

    def __init__(self, strength):
        self.strength = strength
        self.v1 = 0.0

    def step(self, s):
        u = s.speed.tolist()
        i = 0.0
        for n in u:
            n = max(n, 0.0)
            i += 15.0 * n * math.sqrt(n)
        # 21 A in hover; 10 mOhm of leads and cells, 12 mOhm of diffusion
        self.v1 += s.dt * (0.012 * i - self.v1) / 2.5
        v = (s.battery_v - 0.010 * i - self.v1) / 11.5
        v *= v
        start, k = 0.16, self.strength
        out = []
        for n in u:
            n = max(n, 0.02)
            e = max(n - start, 0.0)
            out.append(1.0 + k * (e * e * v / (2.0 * (0.5 - start) * n) - 1.0))
        change = Change()
        change.thrust = np.array(out)
        return change


class TiredBattery:
    """An old or cold battery: its voltage sags with the current of all four motors, at once and over seconds; the
    motors' thrust goes with the square of the voltage (no compensation in the regulators).

        I  = I_h · mean( (u_j/0.5)^1.5 ),     V1' = (R1 I − V1)/τ1
        V  = V_rest − R0 I − V1,              thrust factor (of all) = (V/V_h)²
    Thevenin model with one RC branch (slow polarisation); current of a propeller ~ thrust^1.5 (momentum theory). The factor
    is 1 in hover at a rest voltage of 12 V.
    Source: Plett, Battery Management Systems vol. 1 (equivalent circuits); Chen & Rincón-Mora, IEEE Trans. Energy
    Conv. 21 (2006); Leishman, Principles of Helicopter Aerodynamics (power of hover).
    Felt: 25 A through 60 to 100 mΩ is 1.5 to 2.5 V of 12: the same command gives a quarter less torque at high throttle than at low.
    """

    HOVER, R0, R1, TAU = 25.0, 0.060, 0.040, 2.5

    def __init__(self, strength):
        self.r0, self.r1 = self.R0 * strength, self.R1 * strength
        self.ref = 12.0 - (self.r0 + self.r1) * self.HOVER
        self.v1 = self.r1 * self.HOVER

    def step(self, s: Situation) -> Change:
        a, b, c, d = s.speed.tolist()
        amps = 0.25 * self.HOVER * 2.0 ** 1.5 * (
            a * math.sqrt(a) + b * math.sqrt(b) + c * math.sqrt(c) + d * math.sqrt(d))
        self.v1 += s.dt * (self.r1 * amps - self.v1) / self.TAU
        volts = max(s.battery_v - self.r0 * amps - self.v1, 3.0)
        out = Change()
        out.thrust = np.full(4, (volts / self.ref) ** 2)
        return out


class BadJoint:
    """A poor solder joint or worn bullet connector in the supply of one regulator (motor 0): it drops voltage
    with that motor's own current, and it grows warm, so that its resistance rises within seconds.

        I = I_h (u_0/0.5)^1.5,   R = R_c (1 + α Θ),   Θ' = (R I² R_th − Θ)/τ,   τ = 5 s
        thrust factor of motor 0 = ((V − R I)/V)²
    so the axis gets a moment that goes with about the 2.5th power of that motor's thrust: throttle leaks into it, and
    one direction is weaker than the other.
    Source: Holm, Electric Contacts (constriction resistance, self-heating); Incropera, Fundamentals of Heat and Mass Transfer
    (lumped capacity); Leishman (power ~ thrust^1.5).
    Felt: the standard reason for "it drifts to one corner when I climb".
    """

    HOVER, R, ALPHA, R_TH, TAU = 9.0, 0.018, 0.004, 25.0, 5.0

    def __init__(self, strength):
        self.r = self.R * strength
        self.warm = 0.0

    def step(self, s: Situation) -> Change:
        u = max(float(s.speed[0]), 0.0) / 0.5
        amps = self.HOVER * u * math.sqrt(u)
        r = self.r * (1.0 + self.ALPHA * self.warm)
        self.warm += s.dt * (r * amps * amps * self.R_TH - self.warm) / self.TAU
        left = max(1.0 - r * amps / s.battery_v, 0.2)
        out = Change()
        out.thrust = np.array([left * left, 1.0, 1.0, 1.0])
        return out


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


class AgedBatterySags:
    """Old pack with high inner resistance: the motors get less the more they take.

    A mechanic says: tired, puffed LiPo; saggy battery.
    Source: Thévenin model of a cell with R0 and one R1 C1 pair (Plett, Battery Management Systems
    I, ch. 2); current from the power of the rotors P ~ T^1.5 (actuator disc); thrust ~ V².
    Felt: soft controls, softer at high throttle and some seconds after it.
    """

    def __init__(self, strength: float) -> None:
        self.r0 = 0.055 * strength  # ohm beyond that of a good pack
        self.r1 = 0.040 * strength
        self.tau = 6.0  # s, R1 C1
        self.hover_power = 185.0  # W
        self.polarised = 0.0
        self.volts = 12.0

    def step(self, s: Situation) -> Change:
        share = float(np.mean((np.clip(s.speed, 0.0, None) / HOVER) ** 1.5))
        # the power at the terminals falls with the thrust that is left
        power = self.hover_power * share * (self.volts / s.battery_v) ** 3
        current = power / self.volts
        self.polarised += s.dt / self.tau * (self.r1 * current - self.polarised)
        self.volts = max(s.battery_v - self.polarised - self.r0 * current, 6.0)
        return Change(thrust=np.full(4, (self.volts / s.battery_v) ** 2))


class ColdBattery:
    """A pack from the cold car: its resistance is high, and falls as it warms by its current.

    A mechanic says: cold battery, weak and saggy until it is warm.

    Thevenin model of a cell (Plett, Battery Management Systems I): V = OCV - R0·I - V1, V1 over
    R1·C1; R falls as the pack warms (Arrhenius). The thrust at a duty goes with V², the current
    with thrust^1.5 (momentum theory: power). Felt: low and soft on its throttle, sinks at every
    punch-out, gets better after a minute.
    """

    R0, R1, TAU = 0.045, 0.035, 5.0
    """Ohm beyond those of a warm pack, ohm, s."""
    CURRENT = 5.0
    """A a motor in hover."""
    WARM_J = 9000.0

    def __init__(self, strength):
        self.strength = strength
        self.v1 = 0.0
        self.heat = 0.0

    def step(self, s: Situation) -> Change:
        current = self.CURRENT * float(np.sum((np.maximum(s.speed, 0.0) / HOVER) ** 1.5))
        cold = self.strength * (0.4 + 0.6 * math.exp(-self.heat / self.WARM_J))
        self.v1 += s.dt / self.TAU * (cold * self.R1 * current - self.v1)
        sag = cold * self.R0 * current + self.v1
        self.heat += s.dt * (sag + 2.0) * current
        left = max(0.4, (s.battery_v - sag) / 12.6)
        return Change(thrust=np.full(4, left * left))


class ShakyPlug:
    """The bullet plug of one motor is worn; it opens when its arm is jerked upwards.

    A mechanic says: loose contact at one motor plug.

    Intermittent contact (Holm, Electric Contacts: the contact parts when inertial force exceeds
    the spring's, m·a > F; it closes again after bouncing). Open, one strand conducts and the
    motor has a part of its voltage. Felt: the arm twitches down in hard manoeuvres, and nothing
    can be found in hover or on the bench; a wiggle at the plug brings it back.
    """

    MOTOR = 0
    OPENS = 13.0
    """rad/s² at the arm."""
    LOST = 0.25
    """Part of the command that is lost at strength 1."""
    SPRING_S, BOUNCE_S = 0.006, 0.09

    def __init__(self, strength):
        self.lost = self.LOST * strength
        self.jerk = 0.0
        self.open_until = -1.0

    def step(self, s: Situation) -> Change:
        side = SIDE[s.axis][self.MOTOR]
        self.jerk += s.dt / self.SPRING_S * (side * s.acceleration[s.axis] - self.jerk)
        if self.jerk > self.OPENS:
            self.open_until = s.t + self.BOUNCE_S
        if s.t >= self.open_until:
            return Change()
        command = np.array(s.command, dtype=float)
        command[self.MOTOR] *= 1.0 - self.lost
        return Change(command=command)


PLANTS = (
    Plant('duty_squared_on_sagging_pack', DutySquaredOnSaggingPack, 'bearings', 5, rig=False,
          may_be=('thrust_curve', 'battery_sag')),
    Plant('weak_battery', WeakBattery, 'cables', 9, rig=False,
          may_be=('battery_sag', 'thrust_curve')),
    Plant('corroded_plug', CorrodedPlug, 'cables', 10, rig=True, may_be=('thrust_curve',)),
    Plant('sagging_pack', SaggingPack, 'arms', 6, rig=False,
          may_be=('battery_sag', 'thrust_curve')),
    Plant('corroded_connector', CorrodedConnector, 'arms', 7, rig=False, may_be=('thrust_curve',)),
    Plant('sagging_quadratic', SaggingQuadratic, 'hoses', 8, rig=False,
          may_be=('thrust_curve', 'battery_sag')),
    Plant('tired_battery', TiredBattery, 'slings', 6, rig=False, may_be=('battery_sag',)),
    Plant('bad_joint', BadJoint, 'slings', 8, rig=False,
          may_be=('cross_axis_input', 'battery_sag')),
    Plant('hot_connector', HotConnector, 'umbilicals', 7, rig=False,
          may_be=('cross_axis_input', 'battery_sag')),
    Plant('aged_battery_sag', AgedBatterySags, 'workshop', 5, rig=False, may_be=('battery_sag',)),
    Plant('cold_battery', ColdBattery, 'field', 7, rig=False, may_be=('battery_sag',)),
    Plant('shaky_plug', ShakyPlug, 'field', 8, rig=True),
)
