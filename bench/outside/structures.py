"""Frames, arms, stands and landing gear that bend, and the mounts of camera and gyro."""

from __future__ import annotations

import math

import numpy as np

from .simulator import GAIN_OF, Change, G, Plant, Situation, drive


class FlexibleBoom:
    """Carbon boom across the frame (spray bar): its antisymmetric bending mode.

    q'' + 2ζω q' + d|q'|q' + ω² q + β q³ = -α ; torque = -μ q''  (μ = boom's part of the inertia).
    Craig & Kurdila, Fundamentals of Structural Dynamics; Meirovitch, hybrid coordinates (Likins).
    Quadratic term: air drag of the moving bar; cubic: stretching. Felt because the mode, 4.2 Hz,
    lies at the crossover of the rate loop.
    """

    def __init__(self, strength):
        self.mu, self.q, self.v = 0.11 * strength, 0.0, 0.0
        self.w = 2.0 * math.pi * 4.2

    def step(self, s: Situation) -> Change:
        c, a, w = Change(), s.axis, self.w
        al = float(s.acceleration[a])
        v, q = self.v, self.q
        acc = -al - 2.0 * 0.05 * w * v - 1.5 * abs(v) * v - w * w * q * (1.0 + (q / 0.12) ** 2)
        self.v = v + s.dt * acc
        self.q = q + s.dt * self.v
        c.torque[a] = -self.mu * acc
        return c


class FoamMountedGyro:
    """The sensor box stands on soft foam and turns against the frame.

    q'' = -α - 2ζω q' - ω² (q + z + q³/q1²), z' = g q' - z/τ (Zener branch of the foam); the gyro
    shows rate + q'. ω² = ω0² / strength. Rivin, Passive Vibration Isolation; Lakes, Viscoelastic
    Materials, ch. 2.
    Felt because a heavy box on 10 mm of foam stands at 6 to 9 Hz.
    """

    def __init__(self, strength):
        self.w2 = (2.0 * math.pi * 8.0) ** 2 / strength
        self.w = math.sqrt(self.w2)
        self.q = self.v = self.z = 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        al = float(s.acceleration[a])
        q, v = self.q, self.v
        acc = -al - 2.0 * 0.12 * self.w * v - self.w2 * (q + self.z + q * (q / 0.03) ** 2)
        self.z += s.dt * (0.6 * v - self.z / 0.05)
        self.v = v + s.dt * acc
        self.q = q + s.dt * self.v
        c.gyro[a] = self.v
        return c


class RattlingGear:
    """Folding landing gear with play in its down-lock: it swings between its stops.

    q'' = -α - c q' - ω_g² q + f, f = -k δ (1 + e δ') sgn(q) beyond the gap (Hunt-Crossley),
    torque on the frame = -μ f + μ c q'. Hunt & Crossley, J. Appl. Mech. 42 (1975); Nordin &
    Gutman, "Systems with backlash", 2002.
    Felt because gear is an eighth of the inertia and 2 degrees of play are common.
    """

    def __init__(self, strength):
        self.mu, self.q, self.v = 0.11 * strength, 0.0, 0.0

    def step(self, s: Situation) -> Change:
        c, a = Change(), s.axis
        q, v = self.q, self.v
        deep = abs(q) - 0.03
        f = 0.0
        if deep > 0.0:
            side = 1.0 if q > 0.0 else -1.0
            f = -side * max(5000.0 * deep * (1.0 + 0.8 * side * v), 0.0)
        acc = -float(s.acceleration[a]) - 1.5 * v - 9.0 * q + f
        self.v = v + s.dt * acc
        self.q = q + s.dt * self.v
        c.torque[a] = self.mu * (1.5 * v - f)
        return c


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
        r, k, gain = self.r, self.k, GAIN_OF[s.axis]
        d = drive(s.speed, s.axis)
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


class GelMount:
    """The gyro's board swings on its gel pads and its cable.

    Relative angle φ of the board (viscoelastic gel as standard linear solid, stiffening when pressed):
        φ'' = -dω/dt - ω0² (φ + r z + β φ³) - 2 ζ ω0 φ',    z' = φ' - z/τ
    The gyro shows ω + φ'.
    Source: Rivin, Passive Vibration Isolation (ASME 2003); Lakes, Viscoelastic Materials (Zener
    model); Harris & Piersol, Shock and Vibration Handbook, ch. 30.
    Felt: with pads chosen soft against the propellers' vibration, and a heavy autopilot on them, the
    resonance comes down near the bandwidth of the rate loop: the rates are shown too large and late.
    """

    def __init__(self, strength: float) -> None:
        self.w2 = 43.0**2 / strength
        self.damp = 2.0 * 0.16 * math.sqrt(self.w2)
        self.phi = [0.0, 0.0]
        self.slope = [0.0, 0.0]
        self.z = [0.0, 0.0]

    def step(self, s: Situation) -> Change:
        change = Change()
        for i in range(2):
            phi, slope, z = self.phi[i], self.slope[i], self.z[i]
            pull = self.w2 * (phi + 0.5 * z + 1.5e4 * phi * phi * phi)
            slope = (slope - s.dt * (float(s.acceleration[i]) + pull)) / (1.0 + s.dt * self.damp)
            self.slope[i] = slope
            self.phi[i] = phi + s.dt * slope
            self.z[i] = (z + s.dt * slope) / (1.0 + s.dt / 0.025)
            change.gyro[i] = slope
        return change


class ElasticArms:
    """Folding nylon arms with the motors at their ends: hub and arm tips are two inertias.

    The thrust pushes at the tips and reaches the hub, where the gyro sits, only through the arms'
    bending. With J_tips = mu J, J_hub = (1-mu) J, y the bending as an angle:
        y'' = drive/mu - (k y + c y')/(mu (1-mu)),    hub's acceleration = (k y + c y')/(1-mu)
    (in Y = mu y: Y'' = drive - hub's, hub's = w² Y + 2 zeta w Y', w² = k/(mu (1-mu)): mu only scales y).
        c = c0 (1 + |y|/y0)      (friction in the folding joint: loss grows with amplitude)
    Sources: Meirovitch, Fundamentals of Vibrations (2001), ch. 5 and 7; Gaul & Nitsche, Appl. Mech. Rev.
    54 (2001) 93 (joints). Felt here: first bending mode near 12 Hz, little above the control's bandwidth.
    Strength multiplies the compliance. Acts about roll and pitch.
    """

    def __init__(self, strength):
        self.w = 2.0 * math.pi * 12.3 / math.sqrt(max(strength, 0.02))
        self.y, self.v = [0.0, 0.0], [0.0, 0.0]

    def step(self, s):
        zeta = 0.11
        w = self.w
        change = Change()
        for i in (0, 1):
            a = drive(s.speed, i)
            y, v = self.y[i], self.v[i]
            # y here is the docstring's Y, so that its rest value is drive / w²
            damping = 2.0 * zeta * w * (1.0 + abs(y) / 0.008)
            inner = w * w * y + damping * v
            v += s.dt * (a - inner)
            y += s.dt * v
            self.v[i], self.y[i] = v, y
            change.torque[i] = w * w * y + damping * v - a
        return change


class BendingPlate:
    """The flight controller sits on a thin bottom plate that the arms' roots twist.

    The motors' torque bends the plate; the board tilts by beta against the frame, and the gyro shows
    the speed of that tilt besides the frame's rate. The plate of glass-filled nylon on rubber pads
    follows its load as a Kelvin-Voigt solid whose stiffness hardens:
        T beta' + beta (1 + (beta/beta0)²) = c drive,       gyro = rate + beta'
    Sources: Ward & Sweeney, Mechanical Properties of Solid Polymers, ch. 5; Timoshenko & Woinowsky-
    Krieger, Theory of Plates and Shells (large deflections); base-strain error in sensor makers' notes.
    Felt here: half a degree of tilt at full torque, within 50 ms, is some 0.1 rad/s.
    """

    def __init__(self, strength):
        self.c = 9.5e-4 * strength
        self.beta = [0.0, 0.0]

    def step(self, s):
        change = Change()
        for i in (0, 1):
            b = self.beta[i]
            r = b / 0.012
            d = (self.c * drive(s.speed, i) - b * (1.0 + r * r)) / 0.03
            self.beta[i] = b + s.dt * d
            change.gyro[i] = d
        return change


class SoftMount:
    """Sensor board on foam, which swings against the frame; the gyro measures the board.

    y'' = -2 z w0 y' - w0² (y + n y³) - frame's acceleration;  gyro error = y'   (y: angle of board against frame).
    Foam of a board with its cables: some 8 Hz, a damping of 0.2, stiffer when it is squeezed. Den Hartog, "Mechanical
    Vibrations", ch. 2 (base excitation); Harris' Shock and Vibration Handbook (foam isolators). Below its resonance the
    board overshoots each change of rate, at the resonance it rings on.
    """

    def __init__(self, strength):
        self.w0 = 2.0 * math.pi * 8.5 / math.sqrt(strength)
        self.z, self.n = 0.22, 600.0
        self.y, self.u = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        y, w0 = self.y, self.w0
        pull = w0 * w0 * y * (1.0 + self.n * y * y) + float(s.acceleration[s.axis])
        self.u = (self.u - s.dt * pull) / (1.0 + 2.0 * self.z * w0 * s.dt)
        self.y = y + s.dt * self.u
        change.gyro[s.axis] = self.u
        return change


class GelPad:
    """The flight controller stands on soft gel dampers: the board rocks on them, and the gyro turns with the board.

        δ'' = −φ'' − ω² δ κ(δ) − ω² z − 2 ζ ω δ'
        z'  = e δ' − z/τ,        κ = 0.6 + 0.4/(1 + |δ|/δ_0) + c (δ/δ_0)²   (softer when moved more, hard when squeezed)
        gyro = δ'
    A resonance at some 8 Hz which falls with amplitude (Payne effect) with the loss of rubber (relaxing branch) rather
    than of oil.
    Source: Harris & Piersol, Shock and Vibration Handbook (isolators, base excitation); Lakes, Viscoelastic Materials
    (standard linear solid); Payne, J. Appl. Polymer Sci. 6 (1962).
    Felt: pads against the propellers' vibration are chosen too soft as a rule; the rate that the board shows overshoots
    that of the frame in each quick manoeuvre, by more than a tenth. Strength is the pads' softness: ω² ~ 1/strength.
    """

    HZ, ZETA, EXTRA, TAU = 8.5, 0.13, 0.35, 0.03
    SOFT, HARD = 0.02, 0.05

    def __init__(self, strength):
        self.w2 = (2.0 * math.pi * self.HZ) ** 2 / strength
        self.loss = 2.0 * self.ZETA * math.sqrt(self.w2)
        self.d = self.slope = self.z = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i, dt = s.axis, s.dt
        d = self.d
        x = abs(d) / self.SOFT
        stiff = 0.6 + 0.4 / (1.0 + x) + self.HARD * x * x
        a = -float(s.acceleration[i]) - self.w2 * (stiff * d + self.z)
        self.slope = (self.slope + dt * a) / (1.0 + dt * self.loss)
        self.d = d + dt * self.slope
        self.z = (self.z + self.EXTRA * dt * self.slope) / (1.0 + dt / self.TAU)
        c.gyro[i] = self.slope
        return c


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


class SoftGyroMount:
    """Gyro board on foam: it swings on its pad, which stiffens as it is compressed.

    q'' = -2 z wn (q' - rate) - wn^2 (q - angle) (1 + ((q-angle)/d)^2);  the gyro shows q'.
    Den Hartog, Mechanical Vibrations, ch. 2-3; Duffing stiffening: Harris' Shock and Vibration
    Handbook ch. 4.
    Felt: the heavy controller on soft foam overshoots each quick turn and rings at some 7 Hz.
    """

    def __init__(self, strength):
        self.w2 = (2.0 * math.pi * 7.5) ** 2 / strength
        self.d, self.v, self.old = 0.0, 0.0, None

    def step(self, s: Situation) -> Change:
        c, i = Change(), s.axis
        # d: swing against the hull, v: its rate
        spring = self.w2 * self.d * (1.0 + (self.d / 0.012) ** 2)
        push = -spring - 0.36 * math.sqrt(self.w2) * self.v
        self.v += s.dt * (push - float(s.acceleration[i]))
        self.d += s.dt * self.v
        c.gyro[i] = self.v
        return c


class GelMountAgain:
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


class GyroOnSoggyFoam:
    """The gyro board stands on foam that has gone soft: it swings on it instead of following.

    A mechanic says: gyro tape too soft, wobbling flight controller.
    Source: base-excited oscillator (Den Hartog, Mechanical Vibrations, ch. 2):
    b'' = w0² (a - b) + 2 zeta w0 (a' - b'); the gyro shows b'.
    Felt: press the board with a finger and it wobbles; on film the tail bounces after stops.
    """

    def __init__(self, strength: float) -> None:
        self.w0 = 2.0 * math.pi * 11.0 / math.sqrt(strength)
        self.zeta = 0.22
        self.off = np.zeros(3)  # board behind frame, rad
        self.off_rate = np.zeros(3)

    def step(self, s: Situation) -> Change:
        w = self.w0
        self.off_rate = self.off_rate + s.dt * (
            -s.acceleration - w * w * self.off - 2.0 * self.zeta * w * self.off_rate)
        self.off = self.off + s.dt * self.off_rate
        return Change(gyro=self.off_rate)


class SoftTape:
    """The foam tape under the flight controller has gone soft in the sun: the board wobbles.

    A mechanic says: the flight controller sits loose on its foam pad.

    A board on a spring and damper excited by its base (transmissibility, Den Hartog, Mechanical
    Vibrations): p'' = -w²·p - 2·z·w·p' - a'', p the angle of the board against the frame; the gyro
    shows rate + p'. Felt: press the board with a finger and it rocks; in flight it overshoots and
    shivers after steps.
    """

    HZ, ZETA = 11.0, 0.14

    def __init__(self, strength):
        self.w = 2.0 * math.pi * self.HZ / math.sqrt(strength)
        self.p, self.v = np.zeros(3), np.zeros(3)

    def step(self, s: Situation) -> Change:
        w = self.w
        push = -w * w * self.p - 2.0 * self.ZETA * w * self.v - s.acceleration
        push[2] = 0.0
        self.v = self.v + s.dt * push
        self.p = self.p + s.dt * self.v
        return Change(gyro=self.v.copy())


PLANTS = (
    Plant('flexible_boom', FlexibleBoom, 'cables', 3, rig=False, may_be=('resonance',)),
    Plant('foam_mounted_gyro', FoamMountedGyro, 'cables', 4, rig=True, may_be=('resonance',)),
    Plant('rattling_gear', RattlingGear, 'cables', 5, rig=False),
    Plant('folding_arm_bending', FoldingArmBending, 'arms', 0, rig=False, may_be=('resonance',)),
    Plant('rubber_mounted_gyro', RubberMountedGyro, 'arms', 1, rig=True, may_be=('resonance',)),
    Plant('wire_rope_camera', WireRopeCamera, 'arms', 2, rig=False, may_be=('resonance',)),
    Plant('gel_mount', GelMount, 'joints', 9, rig=False, may_be=('resonance',)),
    Plant('elastic_arms', ElasticArms, 'hoses', 3, rig=False, may_be=('resonance',)),
    Plant('bending_plate', BendingPlate, 'hoses', 5, rig=False),
    Plant('soft_mount', SoftMount, 'gears', 9, rig=True, may_be=('resonance', 'cubic_stiffness')),
    Plant('gel_pad', GelPad, 'slings', 5, rig=False, may_be=('resonance', 'cubic_stiffness')),
    Plant('wire_strand_isolator', WireStrandIsolator, 'chains', 3, rig=False,
          may_be=('resonance', 'coulomb_friction')),
    Plant('clattering_skid_tube', ClatteringSkidTube, 'chains', 4, rig=False,
          may_be=('resonance',)),
    Plant('nodding_pole_stand', NoddingPoleStand, 'chains', 5, rig=True,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('soft_gyro_mount', SoftGyroMount, 'governors', 9, rig=False,
          may_be=('resonance', 'cubic_stiffness')),
    Plant('gel_mount_again', GelMountAgain, 'umbilicals', 3, rig=False,
          may_be=('resonance', 'cubic_stiffness')),
    Plant('gyro_on_soft_foam', GyroOnSoggyFoam, 'workshop', 10, rig=False, may_be=('resonance',)),
    Plant('soft_tape', SoftTape, 'field', 9, rig=True, may_be=('resonance',)),
)
