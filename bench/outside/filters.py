"""Filters of the rate and estimators of bias and attitude whose result is flown with."""

from __future__ import annotations

import math

import numpy as np

from .simulator import GAIN_OF, HOVER, SIDE, Change, G, Plant, Situation


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


class AdaptiveGyroFilter:
    """A low-pass on the gyro that opens with the motion, as the "1 euro" filter and the dynamic
    low-passes do.

    y' = (w − y)/tau, tau = tau0/(1 + |y_s|/w0), y_s the rate behind a slower filter of its own
    (60 ms).
    Source: Casiez, Roussel, Vogel, CHI 2012. Felt: little phase lag when it turns fast, much when
    it turns slowly.
    """

    def __init__(self, strength):
        self.tau, self.w0 = 0.030 * strength, 0.5
        self.y = self.size = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        w = float(s.rate[s.axis])
        self.size += s.dt / 0.06 * (abs(self.y) - self.size)
        tau = self.tau / (1.0 + self.size / self.w0)
        self.y += (w - self.y) * s.dt / (tau + s.dt)
        c.gyro[s.axis] = self.y - w
        return c


class ComplementaryFilterFeedback:
    """The rate that is shown is the corrected one of a Mahony filter, whose accelerometer does
    not see the tilt.

    e = th_acc - th^,  b' = kI e,  shown = w + kP e + b,  th^' = shown; accelerometer of a
    multirotor: th_acc = (D/m)/g with v' = g tan(th) - D/m, D/m = c v + c2 v|v|.
    Source: Mahony, Hamel, Pflimlin, "Nonlinear complementary filters on the special orthogonal
    group", IEEE TAC 53 (2008); Leishman, Saunders, McLain, Beard, "Quadrotors and
    accelerometers", IEEE CSM 34 (2014). In free flight the accelerometer shows drag only: soon
    after tilting it says 'level', and the filter draws the rate towards that error, then the
    other way when speed and drag have grown.
    """

    def __init__(self, strength):
        self.kp, self.ki = 1.0 * strength, 0.12 * strength
        self.th = self.b = self.v = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        v = self.v
        drag = 0.5 * v + 0.08 * v * abs(v)
        e = drag / G - self.th
        self.b += s.dt * self.ki * e
        extra = self.kp * e + self.b
        self.th += s.dt * (float(s.rate[a]) + extra)
        self.v = v + s.dt * (G * math.tan(float(s.angle[a])) - drag)
        c = Change()
        c.gyro[a] = extra
        return c


class IntegerGyroFilter:
    """The gyro's low pass is done in integers, with truncation: y = trunc((7·y + x)/8), in whole
    units of 0.7 °/s.

    x is the rate in counts. Truncation toward zero makes a filter that does not rise until x − y
    reaches 8 counts, yet falls at every step: it shows rates too small by up to 7 counts, always
    toward zero, has a dead zone about zero, and the lag of its 8 ms. Source: Oppenheim & Schafer,
    Discrete-Time Signal Processing, § 6.8-6.9 (dead bands of first-order filters in fixed point);
    Jackson, Bell Syst. Tech. J. 49 (1970) 159. Eight-bit flight controllers worked so (whole
    degrees per second, shifts for divisions). Strength: the unit.
    """

    def __init__(self, strength):
        self.unit = math.radians(0.7) * strength
        self.y = 0

    def step(self, s: Situation) -> Change:
        rate = float(s.rate[s.axis])
        self.y = int((7 * self.y + int(rate / self.unit)) / 8)
        change = Change()
        change.gyro[s.axis] = self.y * self.unit - rate
        return change


class MahonyBiasLeak:
    """Attitude filter that takes the accelerometer for the vertical and puts its error into the gyro's bias.

    In free flight the accelerometer does not feel the tilt but only the drag: φ_a = atan(drag/(g t)).
        e = W (φ_a - φ̂),   dφ̂/dt = ω + b + kp e,   db/dt = ki e - b/τb
        dv/dt = g t sin θ - D,   D = v/τ + c v |v|
        W = 1 / (1 + ((|a| - g)/(σ g))²)    (trusts the accelerometer less when it is not 1 g)
    The rate handed on is that of the filter, ω + kp e + b.
    Source: Mahony, Hamel & Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE TAC
    53 (2008); Martin & Salaün, "The true role of accelerometer feedback in quadrotor control", ICRA 2010;
    PX4 attitude_estimator_q.
    Felt: any sustained tilt in hover leaks into the bias within a second, and the rate loop follows it.
    """

    def __init__(self, strength: float) -> None:
        self.k = strength
        self.v = self.tilt = self.bias = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        m1, m2, m3, m4 = s.speed.tolist()
        t = max((m1 + m2 + m3 + m4) / (4.0 * HOVER), 0.1)
        v = self.v
        drag = v / 1.6 + 0.15 * v * abs(v)
        self.v = v + s.dt * (G * t * math.sin(float(s.angle[a])) - drag)
        felt = math.atan(drag / (G * t))
        off = (math.sqrt(t * t + (drag / G) ** 2) - 1.0) / 0.15
        e = (felt - self.tilt) / (1.0 + off * off)
        self.tilt += s.dt * (float(s.rate[a]) + self.bias + 0.8 * self.k * e)
        self.bias += s.dt * (1.1 * self.k * e - self.bias / 6.0)
        change = Change()
        change.gyro[a] = self.bias + 0.8 * self.k * e
        return change


class BiasEstimator:
    """The attitude filter's integrator learns tilts as gyro bias, and the rate loop uses that gyro.

    In free flight the accelerometer shows no lasting tilt (the thrust lies along the body's z), so the
    filter pulls its attitude to zero and takes the difference as a bias. Mahony's filter, with the usual
    weight that trusts the accelerometer less when its length differs from g:
        e = 0 - est,  est' = gyro - b + kP W e,   b' = -kI W e - b/Tb,      gyro used = gyro - b
        W = 1/(1 + (|a|/g - 1)²/s²),  |a|/g = throttle/0.5
    Sources: Mahony, Hamel & Pflimlin, IEEE TAC 53 (2008) 1203; Leishman et al., Quadrotors and
    accelerometers, IEEE Control Syst. Mag. 34 (2014) 28. Felt here: gains too high by haste (kI = 1.2 /s²)
    show as a slow false rate after each manoeuvre. Two axes alike. Strength multiplies kI.
    """

    def __init__(self, strength):
        self.ki = 1.2 * strength
        self.est, self.b = [0.0, 0.0], [0.0, 0.0]

    def step(self, s):
        off = (s.throttle / 0.5 - 1.0) / 0.25
        weight = 1.0 / (1.0 + off * off)
        change = Change()
        for i in (0, 1):
            e = -self.est[i]
            b = self.b[i]
            self.est[i] += s.dt * (float(s.rate[i]) - b + 1.2 * weight * e)
            self.b[i] = b + s.dt * (-self.ki * weight * e - b / 4.0)
            change.gyro[i] = -b
        return change


class BiasEstimatorAgain:
    """The estimator's bias of the gyro, learned from an accelerometer that does not see the tilt in flight.

    e = f/g - E,  E' = w - b + kp e,  b' = -ki e,  the rate handed on is w - b;
    f = D v + r w'   (specific force along the tilt: drag, and lever arm of the sensor),  v' = g sin(angle) - D v.
    Mahony, Hamel, Pflimlin, "Nonlinear complementary filters on SO(3)", IEEE TAC 53 (2008), in one axis;
    Martin & Salaün, "The true role of accelerometer feedback in quadrotor control", ICRA 2010: a flying
    quadrotor's accelerometer shows drag and not gravity's component. So each tilt is taken for a drift of
    the gyro; with the gains of a hobby filter set for quick convergence the bias wanders by 0.1 rad/s.
    """

    def __init__(self, strength):
        self.ki, self.kp = 0.95 * strength, 1.3
        self.lever, self.drag = 0.05, 0.4
        self.v, self.e, self.b = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        change = Change()
        for a in (0, 1):
            pull = self.drag * self.v[a]
            self.v[a] += s.dt * (G * math.sin(s.angle[a]) - pull)
            wrong = (pull + self.lever * float(s.acceleration[a])) / G - self.e[a]
            self.e[a] += s.dt * (float(s.rate[a]) - self.b[a] + self.kp * wrong)
            self.b[a] -= s.dt * self.ki * wrong
            change.gyro[a] = -self.b[a]
        return change


class HastyBiasEstimator:
    """The attitude filter learns the gyro's bias too eagerly, and trusts an accelerometer that does not feel tilt.

    Mahony's filter; the rate which the software uses and logs is the one less the estimated bias:
        φ̂' = ω − b + k_P e,   b' = −k_I e,   e = f_y/g − φ̂,      gyro = −b
    In free flight the accelerometer shows the rotors' drag only, not the tilt: f_y = d v, v' = g sin φ − d v − d2|v|v; hence
    e is about −φ in quick manoeuvres, and true motion is taken for a bias. The correction fades as the measured
    acceleration departs from 1 g (the usual gate, here smooth): k → k / (1 + ((throttle/0.5 − 1)/0.2)²).
    Source: Mahony, Hamel & Pflimlin, IEEE Trans. Automatic Control 53 (2008); Martin & Salaün, ICRA 2010 (the true role of
    accelerometer feedback in quadrotor control).
    Felt: an integral gain turned up against drift: the rate that is shown sags in each lasting tilt.
    """

    KP, KI, D1, D2 = 0.8, 1.2, 0.35, 0.06

    def __init__(self, strength):
        self.ki = self.KI * strength
        self.phi = self.b = self.v = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        v = self.v
        drag = self.D1 * v + self.D2 * abs(v) * v
        self.v = v + dt * (s.throttle / 0.5 * G * math.sin(float(s.angle[i])) - drag)
        off = (s.throttle / 0.5 - 1.0) / 0.2
        e = (drag / G - self.phi) / (1.0 + off * off)
        self.phi += dt * (float(s.rate[i]) - self.b + self.KP * e)
        self.b -= dt * self.ki * e
        c.gyro[i] = -self.b
        return c


class RpmChasingNotch:
    """A notch filter on the gyro that follows the rotors' frequency by the throttle.

    To keep the rotors' shaking out of the loop the flight controller notches the gyro at
    f = f_h·√(throttle/0.5), wide enough for a crude estimate of f. Below its centre a notch lags:
        H(s) = (s² + ω²)/(s² + (ω/Q)·s + ω²) = 1 - (ω/Q)·s/(s² + (ω/Q)·s + ω²),
    phase ≈ -(f/f_c)/Q, which grows when the throttle goes down (state-variable form, so that moving
    the centre makes no bump). A second one of half the depth sits at the next harmonic.
    Source: Zölzer, Digital Audio Signal Processing (state-variable notch); Zavalishin, The Art of
    VA Filter Design; ArduPilot's documentation, Throttle-based dynamic notch. Felt here: large slow
    propellers (25 turns a second) put the notch within a few octaves of the attitude loop.
    """

    def __init__(self, strength: float) -> None:
        self.width = 1.25 * strength
        self.throttle = 0.5
        self.state = [0.0, 0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        self.throttle += s.dt / 0.1 * (s.throttle - self.throttle)
        centre = 22.0 * math.sqrt(max(self.throttle, 0.1) / 0.5)
        value = true = float(s.rate[s.axis])
        for j, harmonic, depth in ((0, 1.0, 1.0), (2, 2.0, 0.5)):
            g = math.tan(math.pi * centre * harmonic * s.dt)
            low, band = self.state[j], self.state[j + 1]
            new = (band + g * (value - low)) / (1.0 + g * (g + self.width))
            self.state[j + 1] = 2.0 * new - band
            self.state[j] = low + 2.0 * g * new
            value -= depth * self.width * new
        change = Change()
        change.gyro[s.axis] = value - true
        return change


class OverweightObserver:
    """The rate that is shown is an observer's, whose inertia is too large and whose motors too slow.

    A Luenberger (steady Kalman) observer predicts with the commands and is corrected by the gyro:
        dŵ/dt = b̂·m̂ - d̂·ŵ + L·(w - ŵ) + ẑ,   dẑ/dt = L_z·(w - ŵ),   τ̂·dm̂/dt = u - m̂
    with b̂ = b/(1 + ε) (calibrated with a heavier battery) and τ̂ > τ; ẑ learns a constant torque.
    The error obeys (s² + (L+d)s + L_z)·(ŵ - w) = s·(b̂m̂ - true acceleration - ...): it is felt where
    the loop works, and vanishes for slow motion.
    Source: Luenberger, An introduction to observers, IEEE TAC 16 (1971); Franklin, Powell &
    Emami-Naeini, Feedback Control of Dynamic Systems, §7.7; Simon, Optimal State Estimation, ch. 10
    (modelling errors). Felt here: rate estimators with a motor model are usual against gyro noise.
    """

    def __init__(self, strength: float) -> None:
        self.ratio, self.lag = 1.0 / (1.0 + 0.45 * strength), 0.042 * (1.0 + 0.35 * strength)
        self.motor = self.rate = self.trim = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        signs, u = SIDE[i], s.command
        wanted = 0.25 * GAIN_OF[i] * (signs[0] * float(u[0]) + signs[1] * float(u[1])
                                    + signs[2] * float(u[2]) + signs[3] * float(u[3]))
        self.motor += s.dt / self.lag * (wanted - self.motor)
        wrong = float(s.rate[i]) - self.rate
        self.trim += s.dt * 20.0 * wrong
        self.rate += s.dt * (
            self.ratio * self.motor - 0.5 * self.rate + 14.0 * wrong + self.trim)
        change = Change()
        change.gyro[i] = self.rate - float(s.rate[i])
        return change


class RoamingRpmNotch:
    """A notch filter on the gyro that follows the propellers' estimated speed, set far too low.

    y = x - bp/Q,  bp' = Ω (x - bp/Q - lp),  lp' = Ω bp,  Ω = Ω0 √n: n is the throttle behind a slow
    estimator (0.15 s) as Ω_propeller ~ √thrust. A harmonic number set too low and a broad Q put the
    notch at 11 to 14 Hz instead of 60: what is left of it in the loop's band is lag and attenuation.
    Source: state-variable notch in Zölzer, DAFX; RPM filters of Betaflight; Franklin, Powell &
    Emami-Naeini on notch compensation.
    Felt here: the gyro shows the rates 10 to 15 ms late and some 20 % wrong, by throttle.
    """

    HZ, Q, SLOW = 12.5, 0.95, 0.15

    def __init__(self, strength):
        self.damp = strength / self.Q
        self.n = 1.0
        self.bp, self.lp = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        self.n += s.dt / self.SLOW * (2.0 * s.throttle - self.n)
        w = 2.0 * math.pi * self.HZ * (max(0.3, self.n)) ** 0.5 * s.dt
        bp, lp, d = self.bp, self.lp, self.damp
        out = Change()
        for j, x in enumerate(s.rate.tolist()):
            b = (bp[j] + w * (x - lp[j])) / (1.0 + w * d + w * w)
            lp[j] += w * b
            bp[j] = b
            out.gyro[j] = -d * b
        return out


class EstimatorBiasLeak:
    """Attitude filter that takes the craft's tilt for gyro bias, since an accelerometer in
    flight hardly sees tilt.

    Mahony: e = (acc - est) w(rate), est' = gyro - b + kp e, b' = -ki e - b/Tb; the rate handed
    out is gyro - b.
    In free flight acc shows rotor drag only: acc = cd u/g, u' = g angle - cd u.
    w = 1/(1+(rate/r)^2): less trust while turning.  Mahony, Hamel, Pflimlin, IEEE TAC 53
    (2008); Martin & Salaun, ICRA 2010.
    Felt: after a long tilt the reported rate is off for seconds.
    """

    def __init__(self, strength):
        self.k, self.est, self.b, self.u = strength, 0.0, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        rate = float(s.rate[i])
        self.u += s.dt * (G * float(s.angle[i]) - 0.4 * self.u)
        e = (0.4 * self.u / G - self.est) / (1.0 + (rate / 0.8) ** 2)
        self.est += s.dt * (rate - self.b + 1.2 * e)
        self.b += s.dt * (-1.4 * e - self.b / 6.0)
        c.gyro[i] = -self.k * self.b
        return c


class AdaptiveRateFilter:
    """Smoothing of the rate whose cutoff opens with quick motion and with throttle.

    y' = 2 pi fc (x - y),  fc = f0 (1 + g (throttle-0.5)) + beta |slope|,  slope = x' through 3 Hz.
    Casiez, Roussel, Vogel, "1 euro filter", CHI 2012; dynamic low-pass of Betaflight (throttle).
    Felt: slow movements arrive late, quick ones nearly in time.
    """

    def __init__(self, strength):
        self.k, self.y, self.slope = strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        x = float(s.rate[i])
        self.slope += s.dt * 2.0 * math.pi * 3.0 * (float(s.acceleration[i]) - self.slope)
        fc = (4.0 * (1.0 + 3.0 * (s.throttle - 0.5)) + 1.2 * abs(self.slope)) / self.k
        self.y += (x - self.y) * (1.0 - math.exp(-2.0 * math.pi * fc * s.dt))
        c.gyro[i] = self.y - x
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


PLANTS = (
    Plant('false_vertical_of_ahrs', FalseVerticalOfAhrs, 'bearings', 11, rig=False,
          may_be=('pendulum_stiffness',)),
    Plant('adaptive_gyro_filter', AdaptiveGyroFilter, 'rigs', 6, rig=True),
    Plant('complementary_filter_feedback', ComplementaryFilterFeedback, 'hinges', 11, rig=False,
          may_be=('pendulum_stiffness',)),
    Plant('integer_gyro_filter', IntegerGyroFilter, 'arms', 11, rig=True),
    Plant('mahony_bias_leak', MahonyBiasLeak, 'joints', 11, rig=False),
    Plant('bias_estimator', BiasEstimator, 'hoses', 9, rig=False),
    Plant('bias_estimator_again', BiasEstimatorAgain, 'gears', 10, rig=False),
    Plant('hasty_bias_estimator', HastyBiasEstimator, 'slings', 11, rig=False),
    Plant('rpm_chasing_notch', RpmChasingNotch, 'greases', 10, rig=True),
    Plant('overweight_observer', OverweightObserver, 'greases', 11, rig=False,
          may_be=('motor_lag',)),
    Plant('roaming_rpm_notch', RoamingRpmNotch, 'chains', 9, rig=False),
    Plant('estimator_bias_leak', EstimatorBiasLeak, 'governors', 10, rig=False),
    Plant('adaptive_rate_filter', AdaptiveRateFilter, 'governors', 11, rig=True),
    Plant('throttle_notch', ThrottleNotch, 'umbilicals', 10, rig=True),
)
