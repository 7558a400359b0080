"""Twelve effects in four families: flexible structure, moving loads, power supply, propellers and
flight software.

Each is a class with `step(situation) -> Change`, called once per millisecond; see the docstrings
for physics and sources. Angles, rates and torques are those of the excited axis unless it is said
otherwise; torques are angular accelerations.
"""

from __future__ import annotations

import math

import numpy as np
from outside_simulator import Change, Situation

GAIN = (450.0, 400.0, 60.0)
"""rad/s² per unit of command (the aircraft's data sheet)."""
SIDE = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, 1.0, -1.0))
"""On which side of each axis motor 1..4 sits (+: it pushes the angle up)."""
G = 9.81


def differential(speed, axis):
    """The motors' torque in units of command."""
    m = SIDE[axis]
    return 0.25 * (m[0] * speed[0] + m[1] * speed[1] + m[2] * speed[2] + m[3] * speed[3])


# ---------------------------------------------------------------------- 1. flexible frames, arms, mounts, dampers


class FoldingArmBending:
    """Arms on folding hinges bend: the motors (most of the inertia) and the hub with the gyro are
    two bodies.

    The thrusts act on the outer body (share r of the inertia), the gyro sits on the inner one;
    between them acts the hinge, a hardening spring with a viscous loss (per unit of the total
    inertia):
        r·θ1'' = d − f,   (1 − r)·θ0'' = f,   f = k·((1 + 3·β·w0²)·φ + β·φ³) + c·φ',   φ = θ1 −
        θ0,
    where d is the motors' torque and w0 the symmetric sag of the arms under the mean thrust, k·w0
    + k·β·w0³ = (1 − r)·G·T: at more throttle the arms are preloaded deeper into the hardening and
    are stiffer. The hub gets f/(1 − r) in place of d.
    Source: Meirovitch, Fundamentals of Vibrations (2001), ch. 5 (two degrees of freedom,
    semidefinite) and Nayfeh & Mook, Nonlinear Oscillations (1979), ch. 4 (hardening spring with a
    static load). Plastic folding arms of 7" to 10" copters have their first antisymmetric mode at
    some 8 to 15 Hz, within reach of the attitude loop, hence it is felt as a lagging,
    overshooting answer of the hub to the motors. Strength: compliance of the hinge.
    """

    def __init__(self, strength):
        self.r = 0.6
        w = 64.0 / math.sqrt(strength)
        self.k = w * w * self.r * (1.0 - self.r)
        self.c = 2.0 * 0.16 * w * self.r * (1.0 - self.r)
        self.beta = 15.0 / strength ** 2
        self.phi = self.slope = 0.0

    def step(self, s: Situation) -> Change:
        speed = s.speed.tolist()
        r, k, gain = self.r, self.k, GAIN[s.axis]
        d = gain * differential(speed, s.axis)
        load = (1.0 - r) * gain * 0.25 * sum(speed) / k
        w0 = load / (1.0 + self.beta * (0.72 * load) ** 2)
        w0 -= (w0 + self.beta * w0 ** 3 - load) / (1.0 + 3.0 * self.beta * w0 * w0)
        phi = self.phi
        f = k * phi * (1.0 + 3.0 * self.beta * w0 * w0 + self.beta * phi * phi) + self.c * self.slope
        self.slope += s.dt * (d / r - f / (r * (1.0 - r)))
        self.phi = phi + s.dt * self.slope
        change = Change()
        change.torque[s.axis] = f / (1.0 - r) - d
        return change


class RubberMountedGyro:
    """The flight controller rocks on rubber grommets: the gyro shows the plate, not the frame.

    Rubber is a standard linear solid (spring beside a Maxwell element) that hardens; the plate's
    mass sits above the grommets, thus on the tilted rig its weight bends the mount as well:
        ψ'' = −θ'' − k·ψ·(1 + κ·ψ²) − z + p·sin(θ + ψ),   z' = k1·ψ' − z/τ,   shown = θ' + ψ'.
    Source: Snowdon, Vibration and Shock in Damped Mechanical Systems (1968), ch. 1; Rivin,
    Passive Vibration Isolation (2003); Zener's solid: Lakes, Viscoelastic Materials (2009), ch.
    2. Soft grommets with a heavy controller or GPS/camera plate on them have rocking modes of 5
    to 12 Hz: rates are shown too large with a late phase, most in fast turns. Strength:
    compliance.
    """

    def __init__(self, strength):
        self.k = 57.0 ** 2 / strength
        self.k1 = 0.9 * self.k
        self.tau = 0.016
        self.kappa = 160.0
        self.p = 240.0
        self.psi = self.slope = self.z = 0.0
        self.last = None

    def step(self, s: Situation) -> Change:
        rate = float(s.rate[s.axis])
        a = 0.0 if self.last is None else (rate - self.last) / s.dt
        self.last = rate
        psi = self.psi
        self.slope += s.dt * (-a - self.k * psi * (1.0 + self.kappa * psi * psi) - self.z
                              + self.p * math.sin(float(s.angle[s.axis]) + psi))
        self.z += s.dt * (self.k1 * self.slope - self.z / self.tau)
        self.psi = psi + s.dt * self.slope
        change = Change()
        change.gyro[s.axis] = self.slope
        return change


class WireRopeCamera:
    """A camera hangs on wire-rope isolators: a sprung inertia whose damping is the rubbing of
    strands, i.e. hysteresis.

    Bouc–Wen: with φ = θc − θ (camera against frame), per unit of the camera's inertia
        θc'' = −f,   f = ω²·(α·φ + (1 − α)·D·z) + 2·ζ·ω·φ',   D·z' = φ' − ½·|φ'|·z − ½·φ'·|z|,
    and the frame feels +μ·f (μ: camera's inertia against the frame's). Small motions see the
    stiff, stuck strands; large ones the soft slope α with a loss per cycle that does not depend
    on frequency.
    Source: Wen, J. Eng. Mech. Div. ASCE 102 (1976) 249; Demetriades, Constantinou & Reinhorn,
    Study of wire rope systems for seismic protection (Eng. Structures 15, 1993). Cameras on wire
    ropes of copters: a fifth of the frame's inertia, modes of 3 to 6 Hz, in the middle of what
    the attitude loop excites. Strength: μ.
    """

    def __init__(self, strength):
        self.mu = 0.18 * strength
        self.k = 24.0 ** 2
        self.alpha, self.d = 0.45, 0.012
        self.c = 2.0 * 0.05 * 24.0
        self.angle = self.rate = self.z = 0.0

    def step(self, s: Situation) -> Change:
        phi = self.angle - float(s.angle[s.axis])
        slope = self.rate - float(s.rate[s.axis])
        z = self.z
        self.z = z + s.dt / self.d * (slope - 0.5 * abs(slope) * z - 0.5 * slope * abs(z))
        f = self.k * (self.alpha * phi + (1.0 - self.alpha) * self.d * self.z) + self.c * slope
        self.rate -= s.dt * f
        self.angle += s.dt * self.rate
        change = Change()
        change.torque[s.axis] = self.mu * f
        return change


# ---------------------------------------------------------------------- 2. slung, sloshing, shifting loads


class SlungLoad:
    """A load on a rope whose hook sits below the centre of mass, in free flight.

    In the plane of the excited axis, v the aircraft's speed along, γ the rope's angle to the
    vertical, q = thrust/weight:
        v' = q·g·(1 + ρ)·sin θ + ρ·T·sin γ − v/τ,
        L·γ'' = −q·g·cos θ·sin γ − (v' − h·θ'')·cos γ − (b/m)·|w|·w,   w = v + L·γ',
        T = q·g·cos θ·cos γ + L·γ'² − v'·sin γ   (per mass of the load, not below 0),
        torque = −(m·h/J)·T·sin(θ + γ).
    In steady acceleration the rope lies along the thrust and pulls through the centre; in every
    manoeuvre it lags, pulls on the lever h and swings with sqrt(g/L), with quadratic drag and
    with a tension that goes with throttle and swing.
    Source: Bisgaard, Modeling, Estimation and Control of Helicopter Slung Load Systems (Aalborg
    2008); Cicolani & Kanning, NASA TP-3280 (1992). A fifth of the mass on a hook 6 cm below the
    centre is an ordinary delivery. Strength: m·h/J.
    """

    def __init__(self, strength):
        self.c = 0.75 * strength
        self.length, self.h, self.rho, self.tau, self.drag = 0.6, 0.06, 0.2, 2.5, 0.12
        self.v = self.swing = self.slope = 0.0

    def step(self, s: Situation) -> Change:
        th, gamma = float(s.angle[s.axis]), self.swing
        speed = s.speed.tolist()
        w = G * 0.5 * sum(speed)
        sg, cg = math.sin(gamma), math.cos(gamma)
        g = w * math.cos(th)
        a0 = w * (1.0 + self.rho) * math.sin(th) - self.v / self.tau
        hold = g * cg + self.length * self.slope ** 2
        # the tension pulls the aircraft and depends itself on the aircraft's acceleration
        tension = max(0.0, (hold - a0 * sg) / (1.0 + self.rho * sg * sg))
        a = a0 + self.rho * tension * sg
        wind = self.v + self.length * self.slope
        self.slope += s.dt / self.length * (-g * sg - (a - self.h * float(s.acceleration[s.axis])) * cg
                                            - self.drag * abs(wind) * wind)
        self.swing = gamma + s.dt * self.slope
        self.v += s.dt * a
        change = Change()
        change.torque[s.axis] = -self.c * tension * math.sin(th + self.swing)
        return change


class SloshingTank:
    """A half filled spray tank on the rig: the first sloshing mode, with its change of frequency
    and damping by amplitude.

    Rectangular tank of length l, depth d: ω² = g·(π/l)·tanh(π·d/l); the sloshing mass moves by x
    in the tank's frame, z below the pivot:  x'' = −2·ζ·ω·(1 + |x|/x1)·x' − ω²·x·(1 + (x/x3)²) +
    g·sin θ + z·θ''
        torque = (m/J)·(g·x·cos θ − z·(ω²·x·(1 + (x/x3)²) + 2·ζ·ω·(1 + |x|/x1)·x')).
    The liquid runs to the low side and pushes on (free-surface effect), and the wave comes back
    late.
    Source: Abramson (ed.), The Dynamic Behavior of Liquids in Moving Containers, NASA SP-106
    (1966), ch. 6; Ibrahim, Liquid Sloshing Dynamics (2005), ch. 5 (mass-spring model), ch. 4
    (nonlinear). A 20 cm tank sloshes at some 1.7 Hz, the frequency of the attitude changes.
    Strength: sloshing mass.
    """

    def __init__(self, strength):
        length, depth = 0.20, 0.07
        self.k = G * math.pi / length * math.tanh(math.pi * depth / length)
        self.c = 2.0 * 0.07 * math.sqrt(self.k)
        self.m = 15.0 * strength
        self.z, self.x1, self.x3 = 0.03, 0.03, 0.06
        self.x = self.v = 0.0
        self.last = 0.0

    def step(self, s: Situation) -> Change:
        rate, th, x = float(s.rate[s.axis]), float(s.angle[s.axis]), self.x
        a = (rate - self.last) / s.dt
        self.last = rate
        f = self.k * x * (1.0 + (x / self.x3) ** 2) + self.c * (1.0 + abs(x) / self.x1) * self.v
        self.v += s.dt * (G * math.sin(th) + self.z * a - f)
        self.x = x + s.dt * self.v
        change = Change()
        change.torque[s.axis] = self.m * (G * self.x * math.cos(th) - self.z * f)
        return change


class SlidingBattery:
    """A battery slides in its tray under a slack strap, with dry friction between two foam stops
    (it sticks and slips).

        y'' = g·sin θ − (µ·g·cos θ)·F(v) − ks·y − stop,   F(v) = (1 +
        0.35·exp(−(v/vs)²))·tanh(v/v0)   (Stribeck),
        stop = kp·δ^1.5·(1 + c·δ')  (Hunt–Crossley) on the way δ beyond the play,
        torque = (m/J)·(g·y·cos θ − z·(friction + strap + stop)).
    The friction falls as the frame shakes more with throttle (µ = µ0·(1 − 0.8·(throttle − 0.5))).
    The battery stays until the tilt overcomes friction, runs to the stop, and waits there until
    the tilt is reversed: the centre of mass has backlash.
    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083 (friction);
    Hunt & Crossley, J. Appl. Mech. 42 (1975) 440 (stops). A 200 g battery with 1 cm of play is
    found on half of all home-built copters. Strength: m/J.
    """

    def __init__(self, strength):
        self.m = 11.5 * strength
        self.mu, self.v0, self.vs = 0.075, 0.004, 0.02
        self.play, self.kp, self.loss, self.ks, self.z = 0.010, 2.0e5, 4.0, 12.0, 0.02
        self.y = self.v = 0.0

    def step(self, s: Situation) -> Change:
        th, y, v = float(s.angle[s.axis]), self.y, self.v
        ct = math.cos(th)
        mu = self.mu * (1.0 - 0.8 * (s.throttle - 0.5))
        f = mu * G * ct * (1.0 + 0.35 * math.exp(-(v / self.vs) ** 2)) * math.tanh(v / self.v0) + self.ks * y
        over = abs(y) - self.play
        if over > 0.0:
            side = 1.0 if y > 0.0 else -1.0
            f += side * max(0.0, self.kp * over * math.sqrt(over) * (1.0 + self.loss * side * v))
        self.v = v + s.dt * (G * math.sin(th) - f)
        self.y = y + s.dt * self.v
        change = Change()
        change.torque[s.axis] = self.m * (G * self.y * ct - self.z * f)
        return change


# ---------------------------------------------------------------------- 3. power supply


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


class GroundShiftGyro:
    """The motors' return currents flow through the ground of an analogue gyro and pull down its
    supply.

        i_i = u_i^1.5 + a·(command_i − u_i)   (propeller's load and acceleration of the rotor),
        e = Σ side_i·i_i  (current that flows across the board),  d = Σ i_i − hover,
        g' = (e − g)/τg (input filter),  r'' = ω²·(d − r) − 2·ζ·ω·r' (rail: converter with its LC
        filter),
        shown = rate·(1 − s·r) + b·g + c·r.
    Source: Ott, Electromagnetic Compatibility Engineering (2009), ch. 3 (common-impedance
    coupling); Erickson & Maksimović, Fundamentals of Power Electronics, ch. 10 (input filter).
    Rigs with an analogue gyro and one shared ground wire: 10 mΩ at 10 A shift the reading by 100
    mV, some 0.2 rad/s. Strength: the resistance of ground.
    """

    def __init__(self, strength):
        self.b, self.c, self.s = 0.45 * strength, 0.10 * strength, 0.22 * strength
        self.a = 2.2
        self.g = self.r = self.slope = 0.0

    def step(self, s: Situation) -> Change:
        u, c, side = s.speed.tolist(), s.command.tolist(), SIDE[s.axis]
        e = d = 0.0
        for k in range(4):
            i = max(u[k], 0.0) ** 1.5 + self.a * (c[k] - u[k])
            e += side[k] * i
            d += i
        d -= 4.0 * 0.5 ** 1.5
        self.g += s.dt / 0.012 * (e - self.g)
        self.slope += s.dt * (900.0 * (d - self.r) - 2.0 * 0.35 * 30.0 * self.slope)
        self.r += s.dt * self.slope
        change = Change()
        change.gyro[s.axis] = -self.s * self.r * float(s.rate[s.axis]) + self.b * self.g + self.c * self.r
        return change


# ---------------------------------------------------------------------- 4. propellers and flight software


class InflowAndStall:
    """The air through a propeller follows late (dynamic inflow); until it does, the blades bite
    more, up to their stall.

    In units where a steady propeller has Ω² = v² = thrust u, blade element theory and momentum
    theory give
        α = (1 − b·(v + V_i)/Ω)/(1 − b)  (angle of attack, 1 in steady state; V_i = side·R·rate,
        the arm's own up-speed),
        v' = (sqrt(lift) − v)·Ω/(τ·Ωh),
        lift = Ω²·(α − S·f),   f' = (max(0, α − αs) − f)/τs   (separation that builds up late; αs
        = 1.01),
    thrust factor lift/Ω². A change of speed overshoots and relaxes in a tenth of a second; the
    rate is damped, more at high speed of the blades; fast spin-ups stall.
    Source: Pitt & Peters, Vertica 5 (1981) 21; Leishman, Principles of Helicopter Aerodynamics
    (2006), ch. 9 and 10; Carpenter & Fridovich, NACA TN 3044 (1953: overshoot of thrust).
    Flat-pitched plastic blades work near stall. Strength: b and S.
    """

    def __init__(self, strength):
        self.b, self.stall = 0.29 * strength, 0.9 * strength
        self.arm = 0.02
        self.v = [math.sqrt(0.5)] * 4
        self.f = [0.0] * 4

    def step(self, s: Situation) -> Change:
        u, side = s.speed.tolist(), SIDE[s.axis]
        up, b, dt = self.arm * float(s.rate[s.axis]), self.b, s.dt
        v, f, out = self.v, self.f, [0.0] * 4
        for k in range(4):
            o = math.sqrt(max(u[k], 0.01))
            alpha = (1.0 - b * (v[k] + side[k] * up) / o) / (1.0 - b)
            over = alpha - 1.01
            f[k] += dt / 0.03 * ((max(0.0, over)) - f[k])
            c = alpha - self.stall * f[k]
            out[k] = c
            v[k] += dt / 0.11 * o / 0.7071 * (o * math.sqrt(max(c, 0.05)) - v[k])
        change = Change()
        change.thrust = np.array(out)
        return change


class LoggerBlocksControl:
    """The logger writes a block to the SD card now and then, and the motors' task waits behind it
    (priority inversion).

    Every 0.45 s the bus is held for B = B0 + B1·(what was logged: sum of a command's changes
    since the last block; the log is compressed); new commands queue up meanwhile, and then leave
    the queue in order, two for each that arrives: the delay D obeys
        D' = 1 while the bus is held, D' = −1 afterwards until D = 0;   command out(t) = command
        in(t − D).
    A sawtooth of delay, some 30 to 50 ms high, twice a second and more.
    Source: Liu & Layland, J. ACM 20 (1973) 46; Sha, Rajkumar & Lehoczky, IEEE Trans. Comput. 39
    (1990) 1175 (priority inversion); Buttazzo, Hard Real-Time Computing Systems, ch. 7; Cervin et
    al., IEEE Control Systems 23 (2003) 16 (jitter and control). Cards hold their bus for 20 to
    200 ms; known from every flight controller that logs. Strength: the time the bus is held.
    """

    N = 512

    def __init__(self, strength):
        self.b0, self.b1 = 0.029 * strength, 0.02 * strength
        self.queue = [None] * self.N
        self.n = 0
        self.delay = self.left = self.logged = 0.0
        self.next = 300
        self.last = 0.0

    def step(self, s: Situation) -> Change:
        n, command = self.n, tuple(s.command.tolist())
        self.queue[n % self.N] = command
        if n:
            self.logged += abs(command[0] - self.last)
        self.last = command[0]
        if n == self.next:
            self.left = min(0.09, self.b0 + self.b1 * self.logged)
            self.logged, self.next = 0.0, n + 450
        if self.left > 0.0:
            self.left -= s.dt
            self.delay += s.dt
        else:
            self.delay = max(0.0, self.delay - s.dt)
        self.n = n + 1
        change = Change()
        late = min(int(self.delay / s.dt + 0.5), n)
        if late:
            change.command = np.array(self.queue[(n - late) % self.N])
        return change


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


EFFECTS = {
    'folding_arm_bending': (FoldingArmBending, False),
    'rubber_mounted_gyro': (RubberMountedGyro, True),
    'wire_rope_camera': (WireRopeCamera, False),
    'slung_load': (SlungLoad, False),
    'bulging_tank': (SloshingTank, True),
    'sliding_battery': (SlidingBattery, True),
    'sagging_pack': (SaggingPack, False),
    'corroded_connector': (CorrodedConnector, False),
    'ground_shift_gyro': (GroundShiftGyro, True),
    'inflow_and_stall': (InflowAndStall, True),
    'logger_blocks_control': (LoggerBlocksControl, False),
    'integer_gyro_filter': (IntegerGyroFilter, True),
}

FAMILIES = {
    'flexible structure': ('folding_arm_bending', 'rubber_mounted_gyro', 'wire_rope_camera'),
    'moving loads': ('slung_load', 'bulging_tank', 'sliding_battery'),
    'power supply': ('sagging_pack', 'corroded_connector', 'ground_shift_gyro'),
    'propellers and software': ('inflow_and_stall', 'logger_blocks_control', 'integer_gyro_filter'),
}
MAY_BE = {
    'folding_arm_bending': ('resonance',),
    'rubber_mounted_gyro': ('resonance',),
    'wire_rope_camera': ('resonance',),
    'slung_load': ('pendulum_stiffness', 'resonance'),
    'bulging_tank': ('pendulum_stiffness', 'resonance'),
    'sliding_battery': ('coulomb_friction',),
    'sagging_pack': ('battery_sag', 'thrust_curve'),
    'corroded_connector': ('thrust_curve',),
    'inflow_and_stall': ('thrust_curve',),
}
"""Names of the table that are no lie: what the effect contains, or cannot be told from."""
