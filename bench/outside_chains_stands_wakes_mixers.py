"""Twelve effects that a simple model of a quadrotor's attitude axis lacks.

Each is an everyday one with the equation of a textbook or a paper, in normalised form: a torque is
already divided by the inertia of the axis (rad/s²). The state lives in the object; nothing is random.
"""

import math

import numpy as np
from outside_simulator import Change, Situation

G = 9.81
MIX_ROLL = (1.0, -1.0, 1.0, -1.0)
MIX_PITCH = (1.0, -1.0, -1.0, 1.0)


# ------------------------------------------------------------------ cables, slings, hanging loads


class HeapedAnchorChain:
    """A chain hangs from one arm's tip of the rig to a heap on the floor (balanced by a counterweight).

    Rising, the tip lifts further links: their weight is added and they must be brought to its speed;
    sinking, it lays links down, which needs no force. With z = z0 + R sin(angle) the hanging length,
    T = λ (g z + z z'' + z'² [z' > 0]),  torque = -R cos(angle) (T - λ g z0) / J.
    Source: Meriam & Kraige, Dynamics, variable mass (the lifted chain); Irodov, problem 1.177 ff.
    Felt here: the weight of the links is a spring, the hanging part an inertia that grows with the
    angle, and the links picked up brake one direction only. Ground-anchored chains are a usual restraint.
    """

    R, Z0, LOAD = 0.35, 0.30, 2.5

    def __init__(self, strength):
        self.c = strength * self.LOAD
        """λ R / J, 1/m²: 0.1 kg/m at 0.014 kg m²"""
        self.az = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        a, w, wd = float(s.angle[i]), float(s.rate[i]), float(s.acceleration[i])
        ca, sa = math.cos(a), math.sin(a)
        z = max(0.0, self.Z0 + self.R * sa)
        v = self.R * ca * w
        self.az += 0.15 * (self.R * (ca * wd - sa * w * w) - self.az)
        pull = G * (z - self.Z0) + z * self.az + (v * v if v > 0.0 else 0.0)
        out = Change()
        out.torque[i] = -self.c * ca * pull
        return out


class EyeletRopeWrap:
    """A safety line runs from the arm's tip over a fixed eyelet to a small hanging weight.

    Euler-Eytelwein: the arm feels T0 exp(μβ) while it draws line in and T0 exp(-μβ) while it gives
    it back; between, the rope's fibres yield before they slide (Dahl):
    T = T0 exp(μ β z),  z' = (v/δ) (1 - z sgn v),  and the wrap β = β0 + c angle changes with the tilt.
    The weight's inertia adds T0 z''/g. Torque = -R T/J.
    Source: Euler 1769 (any book of statics); Dahl 1968, A solid friction model.
    Felt here: friction that is stronger one way than the other, on top of the weight's pull, and that
    depends on the angle. One-axis rigs are kept from overturning by just such lines.
    """

    PULL, MU, WRAP, BEND, SLIP, ARM = 2.6, 0.27, 1.9, 2.2, 0.012, 0.25

    def __init__(self, strength):
        self.pull = strength * self.PULL
        self.z = 0.0
        self.soft = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        w = float(s.rate[i])
        step = w * s.dt / self.SLIP
        # implicit in the decay, so that it stays within ±1
        self.z = (self.z + step) / (1.0 + abs(step))
        wrap = self.WRAP + self.BEND * float(s.angle[i])
        self.soft += 0.15 * (float(s.acceleration[i]) - self.soft)
        tension = math.exp(self.MU * wrap * self.z) * (1.0 + self.ARM * self.soft / G)
        out = Change()
        out.torque[i] = -self.pull * (tension - 1.0)
        return out


class BifilarCargoTray:
    """A long tray of cargo hangs below the frame by two elastic lines close to each other.

    The frame's tilt against the tray's, y = angle - φ, stretches one line and slackens the other:
    φ'' = (g b / 2 r²) n [f(1 + y/y0) - f(1 - y/y0)] + 2 ζ ω y',  f(x) = (x + √(x² + ε²)) / 2,
    where r is the tray's radius of gyration, b half the distance of the lines, y0 the tilt that takes
    the whole static stretch from one of them, and n = thrust / weight, as the tray is accelerated
    upwards with the aircraft; a line does not push (f). Torque = -(J_tray/J) φ''.
    Source: bifilar suspension in Den Hartog, Mechanical Vibrations; two-cable sling loads: Cicolani &
    Kanning, NASA TP-2768.
    Felt here: an inertia that follows elastically with a resonance of 3 Hz and less when a line is slack.
    """

    RATIO, B, GYRATION, Y0, EPS, ZETA = 0.18, 0.055, 0.15, 0.065, 0.25, 0.07

    def __init__(self, strength):
        self.ratio = strength * self.RATIO
        self.k = G * self.B / (2.0 * self.GYRATION**2)
        self.c = 2.0 * self.ZETA * math.sqrt(2.0 * self.k / self.Y0)
        self.phi = self.phid = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        y = float(s.angle[i]) - self.phi
        x = y / self.Y0
        e = self.EPS * self.EPS
        up, down = 1.0 + x, 1.0 - x
        f = 0.5 * (up - down + math.sqrt(up * up + e) - math.sqrt(down * down + e))
        v = s.speed
        n = 0.5 * float(v[0] + v[1] + v[2] + v[3])
        acc = self.k * n * f + self.c * (float(s.rate[i]) - self.phid)
        self.phid += s.dt * acc
        self.phi += s.dt * self.phid
        out = Change()
        out.torque[i] = -self.ratio * acc
        return out


# ------------------------------------------------------------------ structures and fasteners


class WireStrandIsolator:
    """The camera tray rides on helical wire-rope isolators, whose strands rub on one another.

    Bouc-Wen: with y = φ - angle,  φ'' = -ω² [α y + (1 - α) z] - 2 ζ ω y',
    z' = y' [1 - (1/2 + 1/2 sgn(y' z)) |z/Y|^n],  torque = -(J_tray/J) φ''.
    Source: Bouc 1967, Wen 1976; for wire-rope isolators Demetriades, Constantinou & Reinhorn 1993.
    Felt here: small motions see a stiff mount, large ones a soft and lossy one, with a resonance that
    slides from 6 to 3 Hz with the amplitude, in the middle of the attitude loop's band.
    """

    RATIO, HZ, ALPHA, YIELD, ZETA = 0.2, 5.5, 0.25, 0.010, 0.02

    def __init__(self, strength):
        self.ratio = strength * self.RATIO
        self.w = 2.0 * math.pi * self.HZ
        self.phi = self.phid = self.z = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        yd = self.phid - float(s.rate[i])
        y = self.phi - float(s.angle[i])
        if yd * self.z > 0.0:
            q = self.z / self.YIELD
            self.z += s.dt * yd * (1.0 - min(1.0, q * q))
        else:
            self.z += s.dt * yd
        acc = -self.w * self.w * (self.ALPHA * y + (1.0 - self.ALPHA) * self.z)
        acc -= 2.0 * self.ZETA * self.w * yd
        self.phid += s.dt * acc
        self.phi += s.dt * self.phid
        out = Change()
        out.torque[i] = -self.ratio * acc
        return out


class ClatteringSkidTube:
    """A landing skid whose clamp has worked loose: it turns freely in a gap and strikes its ends.

    φ'' = ω² y + 2 ζ ω y' + F(y - gap) - F(-y - gap),  y = angle - φ,
    Hunt-Crossley: F(d) = k d^1.5 (1 + 1.5 c d') for d > 0, never pulling. A rubber ring centres it
    weakly (ω). Torque = -(J_skid/J) φ''.
    Source: Hunt & Crossley 1975, Coefficient of restitution interpreted as damping in vibroimpact;
    Goldsmith, Impact.
    Felt here: the skid is a ninth of the inertia; it is left behind at each reversal and then caught
    with a knock of some 30 ms.
    """

    RATIO, GAP, K, C, W, ZETA = 0.11, 0.020, 2.2e4, 0.35, 5.0, 0.10

    def __init__(self, strength):
        self.ratio = strength * self.RATIO
        self.phi = self.phid = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        y = float(s.angle[i]) - self.phi
        yd = float(s.rate[i]) - self.phid
        acc = self.W * self.W * y + 2.0 * self.ZETA * self.W * yd
        d = abs(y) - self.GAP
        if d > 0.0:
            sign = 1.0 if y > 0.0 else -1.0
            acc += sign * max(0.0, self.K * d * math.sqrt(d) * (1.0 + 1.5 * self.C * sign * yd))
        self.phid += s.dt * acc
        self.phi += s.dt * self.phid
        out = Change()
        out.torque[i] = -self.ratio * acc
        return out


class NoddingPoleStand:
    """The rig's pivot sits on a slender pole that bends, and the aircraft's centre of mass is below it.

    With x the pole's tip, a the angle, T the thrust, h the distance from pivot to centre of mass:
    M (x'' + 2 ζ ω x' + ω² x) = T sin a + m h (a'' cos a - a'² sin a),
    J a'' = ... - m g h sin a + m h x'' cos a.
    Source: the pendulum on an elastic carriage; Meirovitch, Elements of Vibration Analysis.
    Felt here: a pendulum's stiffness, and a resonance of the stand (2.6 Hz) that the tilting thrust
    drives, the more the higher the throttle.
    """

    MH, MASS, WEIGHT, HZ, ZETA, LEVER = 0.72, 3.0, 12.0, 2.6, 0.08, 0.010

    def __init__(self, strength):
        self.mh = strength * self.MH
        """m h / J, 1/m"""
        self.lever = strength * self.LEVER
        """m h, kg m"""
        self.w = 2.0 * math.pi * self.HZ
        self.x = self.xd = self.soft = 0.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        a, w = float(s.angle[i]), float(s.rate[i])
        sa, ca = math.sin(a), math.cos(a)
        self.soft += 0.2 * (float(s.acceleration[i]) - self.soft)
        v = s.speed
        push = self.WEIGHT * 0.5 * float(v[0] + v[1] + v[2] + v[3]) * sa
        push += self.lever * (self.soft * ca - w * w * sa)
        xdd = push / self.MASS - 2.0 * self.ZETA * self.w * self.xd - self.w * self.w * self.x
        self.xd += s.dt * xdd
        self.x += s.dt * self.xd
        out = Change()
        out.torque[i] = self.mh * (xdd * ca - G * sa)
        return out


# ------------------------------------------------------------------ propulsion and power


class CoastingBladeSpooldown:
    """Speed controllers without active braking: the motor drives a propeller up, only air slows it.

    J Ω' = k i - q Ω², with i not below zero: upwards the current shortens the rise, downwards the
    rotor coasts with J/(2 q Ω), which is also longer the slower it turns:
    lag/lag0 = [1 + b σ((speed - command)/w)] (Ω0/Ω)^p, σ the logistic function, Ω² ~ speed.
    Source: Krishnan, Permanent Magnet Synchronous and Brushless DC Motor Drives; Bangura & Mahony 2014.
    Felt here: the falling motors of each manoeuvre answer twice as late as the rising ones, and all
    are later at low throttle.
    """

    MORE, WIDTH, POWER = 1.0, 0.008, 1.0

    def __init__(self, strength):
        self.more = strength * self.MORE
        self.power = strength * self.POWER

    def step(self, s: Situation) -> Change:
        lag = []
        for c, v in zip(s.command.tolist(), s.speed.tolist(), strict=True):
            x = (v - c) / self.WIDTH
            x = 30.0 if x > 30.0 else max(x, -30.0)
            lag.append((1.0 + self.more / (1.0 + math.exp(-x)))
                       * (0.5 / (max(0.1, v))) ** (0.5 * self.power))
        out = Change()
        out.lag = np.array(lag)
        return out


class WakeFillingDelay:
    """Large, slow propellers: their wake must be accelerated before it weakens the blades' incidence.

    Momentum theory with the apparent mass of air (Carpenter & Fridovich), in units of hover:
    τ v' = T - v |v|,   blade element: T = n + κ √n (√n - v - u),
    n the quasi-steady thrust (speed / 0.5), v the induced velocity, u = ± arm rate / v_hover the
    hub's own motion. Thus a step of speed overshoots in thrust by some κ/2 and settles in τ/2.
    Source: Carpenter & Fridovich, NACA TN 3044; Leishman, Principles of Helicopter Aerodynamics, ch. 10.
    Felt here: each differential command gives an extra push at first, faster settling at high thrust,
    and the rolling rotors damp.
    """

    KAPPA, TAU, HUB = 0.75, 0.24, 0.05

    def __init__(self, strength):
        self.kappa = strength * self.KAPPA
        self.v = [1.0, 1.0, 1.0, 1.0]

    def step(self, s: Situation) -> Change:
        p, q, _ = s.rate.tolist()
        h = s.dt / self.TAU
        k, v, factor = self.kappa, self.v, []
        for j, speed in enumerate(s.speed.tolist()):
            n = 2.0 * speed if speed > 0.05 else 0.1
            root = math.sqrt(n)
            u = self.HUB * (MIX_ROLL[j] * p + MIX_PITCH[j] * q)
            thrust = n + k * root * (root - v[j] - u)
            v[j] += h * (thrust - v[j] * abs(v[j]))
            factor.append(thrust / n)
        out = Change()
        out.thrust = np.array(factor)
        return out


class RoomWashReturn:
    """In a small laboratory the propellers' wash comes back: tilted jets run along floor and wall
    and arrive, later, from above at the rotors of the side to which they were thrown.

    torque = -c n w,   τ w' = q (1 + β |q|) - w,   q = sin(angle(t - d)),
    d = d0 / √n (jet velocity ~ √thrust), n = thrust / hover's thrust; the plume's share that comes
    back grows with its deflection (β).
    Source: Abramovich, The Theory of Turbulent Jets; transport lag as in Åström & Hägglund.
    Felt here: the rig is in a closed room; a torque follows the angle of a third of a second ago,
    sooner and stronger at high throttle.
    """

    PUSH, DELAY, MIXING, BETA, SIZE = 7.5, 0.24, 0.08, 2.0, 700

    def __init__(self, strength):
        self.push = strength * self.PUSH
        self.past = [0.0] * self.SIZE
        self.k = 0
        self.w = 0.0
        self.n = 1.0

    def step(self, s: Situation) -> Change:
        i = s.axis
        v = s.speed
        n = 0.5 * float(v[0] + v[1] + v[2] + v[3])
        self.n += s.dt / 0.1 * (n - self.n)
        self.past[self.k] = math.sin(float(s.angle[i]))
        back = min(self.SIZE - 3.0, 1000.0 * self.DELAY / math.sqrt(max(0.2, self.n)))
        whole = int(back)
        part = back - whole
        a = self.past[(self.k - whole) % self.SIZE]
        a += part * (self.past[(self.k - whole - 1) % self.SIZE] - a)
        self.k = (self.k + 1) % self.SIZE
        self.w += s.dt / self.MIXING * (a * (1.0 + self.BETA * abs(a)) - self.w)
        out = Change()
        out.torque[i] = -self.push * self.n * self.w
        return out


# ------------------------------------------------------------------ flight-control software


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


class StaleMailboxBeat:
    """The output processor fetches the motor commands from a mailbox in its own slow rhythm.

    command_j(t) = command(t_k), t_k = k P + phase_j: two boards of two motors each, a third of
    a period apart, and not synchronous with the control loop, so that the age of a command beats between zero
    and P: sample and hold without agreement of clocks.
    Source: Åström & Wittenmark, Computer-Controlled Systems (hold, latency P/2); Kopetz, Real-Time Systems.
    Felt here: with P = 26 ms the commands come in stairs, 13 ms late on average, and half of the
    motors before the others, which couples the axes.
    """

    PERIOD, SHIFT = 0.0263, 0.37

    def __init__(self, strength):
        self.period = strength * self.PERIOD
        self.due = [0.0, self.SHIFT * self.period]
        self.held = [0.5, 0.5, 0.5, 0.5]

    def step(self, s: Situation) -> Change:
        for board in (0, 1):
            if s.t >= self.due[board]:
                self.due[board] += self.period
                self.held[2 * board] = float(s.command[2 * board])
                self.held[2 * board + 1] = float(s.command[2 * board + 1])
        out = Change()
        out.command = np.array(self.held)
        return out


class HeadroomCompander:
    """A mixer that keeps every motor within its headroom by shrinking all differences alike.

    room = κ min(top - throttle, throttle - idle),  peak = max|command - throttle|,
    wanted = min(1, (room / peak)^m) with m = 1 - 1/(compression ratio);
    the factor g falls to `wanted` at once (4 ms) and recovers with 0.15 s, as a limiter with attack
    and release does: command = throttle + g (command - throttle).
    Source: desaturation in the mixers of PX4 and Betaflight (motor mix range); limiter: Zölzer, DAFX;
    directional control allocation: Bodson 2002.
    Felt here: hard manoeuvres are answered weakly, and so is what follows within a fifth of a
    second; more so at low and high throttle.
    """

    TOP, IDLE, SHARE, SLOPE, ATTACK, RELEASE = 0.72, 0.30, 0.27, 0.7, 0.004, 0.15

    def __init__(self, strength):
        self.slope = self.SLOPE * strength
        self.g = 1.0

    def step(self, s: Situation) -> Change:
        c = s.command.tolist()
        mean = s.throttle
        peak = max(max(c) - mean, mean - min(c))
        room = self.SHARE * max(0.05, min(self.TOP - mean, mean - self.IDLE))
        wanted = (room / peak) ** self.slope if peak > room else 1.0
        slow = self.ATTACK if wanted < self.g else self.RELEASE
        self.g += s.dt / slow * (wanted - self.g)
        g = self.g
        out = Change()
        out.command = np.array([mean + g * (x - mean) for x in c])
        return out


EFFECTS = {
    'heaped_anchor_chain': (HeapedAnchorChain, True),
    'eyelet_rope_wrap': (EyeletRopeWrap, True),
    'bifilar_cargo_tray': (BifilarCargoTray, False),
    'wire_strand_isolator': (WireStrandIsolator, False),
    'clattering_skid_tube': (ClatteringSkidTube, False),
    'nodding_pole_stand': (NoddingPoleStand, True),
    'coasting_blade_spooldown': (CoastingBladeSpooldown, True),
    'wake_filling_delay': (WakeFillingDelay, False),
    'room_wash_return': (RoomWashReturn, True),
    'roaming_rpm_notch': (RoamingRpmNotch, False),
    'stale_mailbox_beat': (StaleMailboxBeat, False),
    'headroom_compander': (HeadroomCompander, True),
}

FAMILIES = {
    'cables': ('heaped_anchor_chain', 'eyelet_rope_wrap', 'bifilar_cargo_tray'),
    'structures': ('wire_strand_isolator', 'clattering_skid_tube', 'nodding_pole_stand'),
    'propulsion': ('coasting_blade_spooldown', 'wake_filling_delay', 'room_wash_return'),
    'software': ('roaming_rpm_notch', 'stale_mailbox_beat', 'headroom_compander'),
}

MAY_BE = {
    'heaped_anchor_chain': ('pendulum_stiffness', 'quadratic_drag'),
    'eyelet_rope_wrap': ('coulomb_friction',),
    'bifilar_cargo_tray': ('resonance',),
    'wire_strand_isolator': ('resonance', 'coulomb_friction'),
    'clattering_skid_tube': ('resonance',),
    'nodding_pole_stand': ('pendulum_stiffness', 'resonance'),
    'coasting_blade_spooldown': ('motor_lag',),
    'wake_filling_delay': ('gyroscopic_coupling',),
    'room_wash_return': ('pendulum_stiffness',),
    'stale_mailbox_beat': ('motor_lag', 'cross_axis_input'),
    'headroom_compander': ('saturation',),
}
