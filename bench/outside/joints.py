"""Friction, play, stops and dampers of bearings, hinges and gears."""

from __future__ import annotations

import math

from .simulator import HOVER, INERTIA, Change, Plant, Situation


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


class LoadedPivotFriction:
    """Plain pivot bearing with presliding friction whose level follows the load on the bearing.

    Dahl: dF/dt = sigma·w·(1 − F/Fc·sgn w); Fc = mu·r·N/I with N = weight − lift (thrust relieves
    the pivot), and sigma = Fc/x0: the asperities bend over some hundredths of a radian before
    they slide.
    Source: P. Dahl, "A solid friction model" (1968); Armstrong-Hélouvry, Dupont, Canudas de Wit,
    Automatica 30 (1994). Felt: a rig's axle carries the aircraft; its friction holds against
    small torques and grows when the throttle goes down.
    """

    def __init__(self, strength):
        self.fc, self.x0, self.f = 1.0 * strength, 0.015, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        w = float(s.rate[s.axis])
        lift = float(s.speed.sum()) * 0.5
        load = max(1.7 - lift, 0.15) / 0.7
        fc = self.fc * load
        f = self.f + s.dt * fc / self.x0 * (w - abs(w) * self.f / fc)
        self.f = min(max(f, -fc), fc)
        c.torque[s.axis] = -self.f
        return c


class FoamStops:
    """Foam end stops left and right, unevenly placed, met at 6 and 8 hundredths of a radian.

    Hunt & Crossley: M = k·d^1.5·(1 + 1.5·e·d') for the depth d > 0 (never pulling); IEEE/ASME J.
    Appl. Mech. 42 (1975) 440. Felt: rigs have bumpers that save the propellers; the square
    reference lies in them.
    """

    def __init__(self, strength):
        self.k = 45.0 * strength

    def step(self, s: Situation) -> Change:
        c = Change()
        a, w = float(s.angle[s.axis]), float(s.rate[s.axis])
        if a > 0.06:
            d = a - 0.06
            c.torque[s.axis] = -self.k * d * math.sqrt(d) * max(1.0 + 0.5 * w, 0.0)
        elif a < -0.08:
            d = -0.08 - a
            c.torque[s.axis] = 1.2 * self.k * d * math.sqrt(d) * max(1.0 - 0.5 * w, 0.0)
        return c


class PlainBearingLuGre:
    """Dry plain bush of the rig's axle: LuGre friction with Stribeck dip, under a load that the
    lift relieves.

    z' = w - s0 |w| z / g(w),  g(w) = N [Mc + (Ms - Mc) exp(-(w/ws)^2)], M = -(s0 z + s1
    exp(-(w/wd)^2) z' + c w),  N = (W_frame + W - T)/(W_frame) with the thrust T ~ throttle.
    Source: Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with
    friction", IEEE TAC 40 (1995); normal load as in Armstrong-Helouvry, Dupont, Canudas de Wit,
    Automatica 30 (1994). On a one-axis rig the bush carries frame and aircraft minus lift; its
    friction holds the small angles fast, gives way at the start of each move and is smaller when
    the throttle is high.
    """

    def __init__(self, strength):
        self.k = strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        w = float(s.rate[a])
        load = max(0.25, (1.6 - s.throttle / 0.5) / 0.6)
        g = self.k * load * (0.9 + 0.5 * math.exp(-(w / 0.12) ** 2))
        s0 = 220.0 * self.k
        r = s0 * abs(w) / g
        h = s.dt
        # exact for constant w, g
        new = self.z + w * h if r * h < 1e-6 else w / r + (self.z - w / r) * math.exp(-r * h)
        zdot = (new - self.z) / h
        self.z = new
        c = Change()
        c.torque[a] = -(s0 * new + 5.0 * self.k * math.exp(-(w / 0.15) ** 2) * zdot + 0.15 * self.k * w)
        return c


class ElastomerHinge:
    """Rubber torsion hinge between rig and aircraft: relaxing (Zener) spring that hardens.

    M = -(k0 th + k3 th^3 + F),  F' = k1 w - F/tau   (standard linear solid, cubic static spring).
    Source: Lakes, "Viscoelastic Materials", ch. 2; Ferry, "Viscoelastic Properties of Polymers";
    cubic shear stiffness of rubber bushes: Nashif, Jones, Henderson, "Vibration Damping".
    Bonded-rubber pivots and wrapped cable looms across the axle are used on rigs because they
    need no bearing: stiff to a quick motion, soft half a second later, stiffer at large angles.
    """

    def __init__(self, strength):
        self.k = strength
        self.f = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        th, w = float(s.angle[a]), float(s.rate[a])
        self.f += s.dt * (5.0 * w - self.f / 0.45)
        c = Change()
        c.torque[a] = -1.5 * self.k * (1.6 * th + 45.0 * th ** 3 + self.f)
        return c


class PayloadHingePlay:
    """Payload (camera) on a hinge with free play beneath the aircraft.

    Relative angle q, play +-d:  q'' = -w' - wp^2 sin(th + q) - M/Jp, M/Jp = wc^2 dz(q) + [2 zc wc
    in contact] q' + 2 z0 wc q',  dz(q) = q - clip(q, -d, d); torque on the aircraft + mu M/Jp, mu
    = Jp/J.
    Source: dead-zone compliance of Nordin and Gutman, "Controlling mechanical systems with
    backlash - a survey", Automatica 38 (2002); pendulum with mount: Den Hartog, "Mechanical
    Vibrations". A worn camera gimbal hangs freely within its play and is carried along only in
    contact: the aircraft's inertia changes between with and without payload, with a knock that is
    softened by the hinge's rubber.
    """

    def __init__(self, strength):
        self.mu = 0.18 * strength
        self.q = self.v = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        wc, d = 2.0 * math.pi * 6.0, 0.02
        q, v = self.q, self.v
        dz = q - d if q > d else (q + d if q < -d else 0.0)
        moment = wc * wc * dz + (2.0 * (0.22 if dz else 0.0) + 2.0 * 0.03) * wc * v
        swing = 3.5 ** 2 * math.sin(float(s.angle[a]) + q)
        self.v = v + s.dt * (-float(s.acceleration[a]) - swing - moment)
        self.q = q + s.dt * self.v
        c = Change()
        c.torque[a] = self.mu * moment
        return c


class BallBearingPrerolling:
    """Rolling hysteresis of the rig's preloaded ball bearings on a race that is not round.

    A preloaded ball bearing that only swings to and fro does not slide: at each reversal the balls
    creep through micro-slip in their contacts, and the torque follows a hysteresis loop over ANGLE
    with non-local memory, nearly independent of rate. It is modelled by Maxwell-slip elements:
        dz_j = dθ, |z_j| <= Z_j;    M = -P(θ) Σ W_j z_j / Z_j
    Second term: the preload P is not constant; race waviness and a tilted outer ring make it
    vary with the ball pitch, P = P0 (1 + a cos(n θ + φ)).
    Source: Todd & Johnson, "A model for Coulomb torque hysteresis in ball bearings", Int. J. Mech.
    Sci. 29 (1987); Al-Bender, Lampaert & Swevers, "The generalized Maxwell-slip model", IEEE TAC
    50 (2005); Harris, Rolling Bearing Analysis (waviness).
    Felt: every rig on angular contact bearings swings by fractions of a ball pitch, so it is in
    the pre-rolling range half of the time.
    """

    REACH = (0.008, 0.03, 0.08, 0.18)
    WEIGHT = (0.25, 0.30, 0.25, 0.20)

    def __init__(self, strength: float) -> None:
        self.level = 1.25 * strength
        self.z = [0.0, 0.0, 0.0, 0.0]

    def step(self, s: Situation) -> Change:
        a = s.axis
        move = float(s.rate[a]) * s.dt
        z, m = self.z, 0.0
        for j in range(4):
            reach = self.REACH[j]
            x = z[j] + move
            x = reach if x > reach else max(x, -reach)
            z[j] = x
            m += self.WEIGHT[j] * x / reach
        preload = 1.0 + 0.4 * math.cos(9.0 * float(s.angle[a]) + 0.7)
        change = Change()
        change.torque[a] = -self.level * preload * m
        return change


class GreaseThixotropy:
    """Grease in the rig's joint: shear thinning, with a yield stress, and thixotropic.

    The soap structure λ (1 whole, 0 broken) heals at rest and is broken by shear:
        dλ/dt = a (1 - λ) - b |ω| λ
        M = -λ My (1 - exp(-m |ω|)) sgn ω  -  (c0 + c1 λ) |ω|^n sgn ω,   n = 0.55
    (Moore's kinetics, Herschel-Bulkley flow with Papanastasiou's regularised yield). So the friction
    depends on how much the joint has been moved in the last second.
    Source: Moore, Trans. Brit. Ceramic Soc. 58 (1959); Papanastasiou, J. Rheology 31 (1987);
    Lugt, Grease Lubrication in Rolling Bearings (Wiley 2013), ch. 5; Mewis & Wagner (2009).
    Felt: small rigs use sealed bearings filled with stiff grease; its drag is far more than that of
    the balls, and is not linear damping.
    """

    def __init__(self, strength: float) -> None:
        self.k = 0.8 * strength
        self.whole = 0.7

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        size = abs(w)
        self.whole += s.dt * (1.0 * (1.0 - self.whole) - 5.0 * size * self.whole)
        lam = self.whole
        flow = w / (w * w + 4e-4) ** 0.225
        yielded = math.copysign(1.0 - math.exp(-25.0 * size), w)
        change = Change()
        change.torque[s.axis] = -self.k * (1.7 * lam * yielded + (0.6 + 1.8 * lam) * flow)
        return change


class BushingUnderThrust:
    """Plain bushing of the rig, whose load is what the rotors do not lift; mixed lubrication.

    Bearing load (in weights of the aircraft), with W the weight of aircraft and cradle:
        N = sqrt(P² + (W - t cos θ)² + (t sin θ)²),   t = ΣT / ΣT_hover
    Friction M = -N r μ, with bristles before sliding (LuGre):
        dz/dt = ω - σ |ω| z / g,   g = N [μc + (μs - μc) exp(-(ω/ωs)²)],   ωs = ω0 N
    The Stribeck speed grows with load (constant Hersey number η ω / p), and M = -(σ z + σ1 dz/dt).
    Source: Canudas de Wit, Olsson, Åström & Lischinsky, IEEE TAC 40 (1995); Armstrong-Hélouvry, Dupont
    & Canudas de Wit, Automatica 30 (1994); Hamrock, Fundamentals of Fluid Film Lubrication (Hersey).
    Felt: the throttle relieves the bearing; at 0.42 the axis sticks, at 0.6 it is nearly free.
    """

    STIFF = 450.0

    def __init__(self, strength: float) -> None:
        self.k = 3.6 * strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        a = s.axis
        w, angle = float(s.rate[a]), float(s.angle[a])
        m1, m2, m3, m4 = s.speed.tolist()
        t = (m1 + m2 + m3 + m4) / (4.0 * HOVER)
        up, side = 1.30 - t * math.cos(angle), t * math.sin(angle)
        load = math.sqrt(0.01 + up * up + side * side)
        x = w / (0.35 * load)
        g = self.k * load * (0.75 + 0.6 * math.exp(-x * x))
        before = self.z
        self.z = (before + s.dt * w) / (1.0 + s.dt * self.STIFF * abs(w) / max(g, 1e-6))
        change = Change()
        change.torque[a] = -(self.STIFF * self.z + 3.0 * (self.z - before) / s.dt)
        return change


class LoadedBearing:
    """Rolling bearings of the gimbal axis: LuGre friction with a Stribeck dip and a load.

    z' = w - s0 |w| z / g(w),  g(w) = N [Fc + (Fs - Fc) exp(-(w/ws)²)],
    torque = -(s0 z + s1 exp(-(w/wd)²) z'),  N = (W - T) / (W - T_hover).
    z is the mean deflection of the asperities; N is the radial load of the bearing, weight of the
    rig's moving part less the lift of the rotors, so that the friction falls as the throttle rises.
    Canudas de Wit, Olsson, Åström, Lischinsky, "A new model for control of systems with friction",
    IEEE Trans. Autom. Control 40 (1995); Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30
    (1994), for Stribeck curve and load. A rig's bearings are greased, sealed and turn to and fro at less
    than a rad/s: they spend the flight about the reversal, where friction is not viscous.
    """

    def __init__(self, strength):
        self.fc, self.fs = 0.78 * strength, 1.25 * strength
        self.s0, self.s1 = 170.0 * strength, 3.0 * strength
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        w = float(s.rate[s.axis])
        lift = float(s.speed.sum()) * 0.5  # in units of the weight of the aircraft, 1 in hover
        load = max((1.6 - lift) / 0.6, 0.15)
        g = load * (self.fc + (self.fs - self.fc) * math.exp(-((w / 0.12) ** 2)))
        pace = abs(w) * self.s0 / g
        end = math.copysign(g / self.s0, w)
        z = end + (self.z - end) * math.exp(-pace * s.dt)
        slope = (z - self.z) / s.dt
        self.z = z
        change.torque[s.axis] = -(self.s0 * z + self.s1 * math.exp(-((w / 0.25) ** 2)) * slope)
        return change


class GearPlay:
    """Backlash of the gear to the angle sensor's drum (with its trim weight) on the rig.

    The drum (inertia m relative to the axis) is driven through teeth with a play of ±a:
    contact torque F = k dz(D) + c D' where teeth touch, zero in the gap and never pulling,
    D = angle - drum angle, dz(D) = D -+ a outside ±a;  m w2' = F - b w2 - f tanh(w2/w0);
    the axis feels -F. Nordin & Gutman, "Controlling mechanical systems with backlash - a survey",
    Automatica 38 (2002), eq. of the dead zone with damping. At each reversal the axis
    runs free for a moment, then picks up the drum with its inertia and its drag.
    """

    def __init__(self, strength):
        self.m = 0.13 * strength
        self.k, self.c = 250.0 * strength, 3.0 * strength
        self.b, self.f = 0.5 * strength, 0.4 * strength
        self.half = 0.035
        self.angle, self.rate = 0.0, 0.0

    def step(self, s: Situation) -> Change:
        change = Change()
        a = s.axis
        d = float(s.angle[a]) - self.angle
        slip = float(s.rate[a]) - self.rate
        force = 0.0
        if d > self.half:
            force = max(self.k * (d - self.half) + self.c * slip, 0.0)
        elif d < -self.half:
            force = min(self.k * (d + self.half) + self.c * slip, 0.0)
        drag = self.b * self.rate + self.f * math.tanh(self.rate / 0.03)
        self.rate += s.dt * (force - drag) / self.m
        self.angle += s.dt * self.rate
        change.torque[a] = -force
        return change


class ShockDamper:
    """A small oil and gas shock absorber between the rig's arm and its base, as sold for model cars.

    Oil passes a laminar leak beside the piston and sharp-edged holes in it, in parallel; the flap valve closes
    part of the holes on rebound. The rod end is a rubber bushing of stiffness k in series:
        F' = k (φ' − v),     v = F/c + C± √|F| sgn F          (C+ for bump, C− for rebound)
        torque = −F − F_g [ (1 − φ/φ_0)^(−1.3) − 1 ]           (gas behind the oil, polytropic)
    so that it is weak and quadratic when slow, linear when fast, uneven to both sides, and a little late. Taken by
    backward Euler, which has a closed form here.
    Source: Dixon, The Shock Absorber Handbook (2nd ed., ch. 6-7); Segel & Lang, Vehicle System Dynamics 10 (1981).
    Felt: it is there to be felt, and never gives the viscous damping on its label.
    """

    BUSH, LEAK, BUMP, REBOUND = 60.0, 6.0, 0.60, 0.12
    GAS, STROKE = 0.9, 0.8

    def __init__(self, strength):
        self.strength = strength
        self.force = 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        i = s.axis
        phi, p = float(s.angle[i]), float(s.rate[i])
        dk = s.dt * self.BUSH
        right = self.force + dk * p
        hole = dk * (self.BUMP if right > 0.0 else self.REBOUND)
        lead = 1.0 + dk / self.LEAK
        root = (math.sqrt(hole * hole + 4.0 * lead * abs(right)) - hole) / (2.0 * lead)
        self.force = root * root if right > 0.0 else -root * root
        left = max(1.0 - phi / self.STROKE, 0.1)
        c.torque[i] = -self.strength * (self.force + self.GAS * (left ** -1.3 - 1.0))
        return c


class SludgyGreaseGel:
    """A rig's pivot packed with a soap-thickened grease: a thixotropic yield-stress fluid.

    The soap fibres form a gel (structure q, 0..1) that shearing breaks and that builds up again at
    rest within a second. Houška's model: a Herschel-Bulkley law whose yield and consistency depend
    on the structure,
        torque = -[ q·Y·sat(w) + (K0 + K1·q)·|w|^n·sgn(w) ],   n = 0.6 (shear thinning)
        dq/dt = a·(1 - q) - b·q·|w|
    Source: Houška (1981), Engineering aspects of the rheology of thixotropic liquids; Mewis &
    Wagner, Thixotropy, Adv. Colloid Interface Sci. 147 (2009); Lugt, Grease Lubrication in Rolling
    Bearings (2013), ch. 5. Felt here: a rig pivot swings at below 2 rad/s, so the gel breaks and
    heals within each manoeuvre: it holds after a pause and lets go once it has been moving.
    """

    def __init__(self, strength: float) -> None:
        self.yielding, self.base, self.extra = 1.5 * strength, 0.25 * strength, 0.9 * strength
        self.q = 1.0

    def step(self, s: Situation) -> Change:
        w = float(s.rate[s.axis])
        pace = abs(w)
        self.q += s.dt * (1.2 * (1.0 - self.q) - 6.0 * self.q * pace)
        soft = math.tanh(w / 0.06)
        change = Change()
        change.torque[s.axis] = -soft * (
            self.q * self.yielding + (self.base + self.extra * self.q) * pace**0.6)
        return change


class DentedRaceValleys:
    """A ball bearing of the rig with false-brinelling dents: the balls lie in valleys.

    Balls that shook on the spot during transport have worn shallow dents into the race, here three
    places within the working range. Each is a potential well, U_k = -D_k·exp(-x²/(2·b²)), x the
    angle from the dent, so the shaft feels -dU/dx: pulled in within the valley, free between them.
    The closely conforming contact in a dent also slips (Heathcote slip), which adds friction there:
        torque = -Σ [ A_k·(x/b)·exp(½ - x²/(2b²)) + F·exp(-x²/(2b²))·sat(w) ]
    Source: Harris & Kotzalas, Rolling Bearing Analysis (Heathcote slip; indentations); Godfrey,
    Fretting corrosion or false brinelling?, Tribology & Lubrication Technology (2003). Felt here:
    a torque of the angle, alternating within a few degrees, in a range of ±0.25 rad that covers all
    three valleys.
    """

    DENTS = ((0.02, 1.0), (0.17, 0.75), (-0.14, 0.9))

    def __init__(self, strength: float) -> None:
        self.pull, self.slip = 1.55 * strength, 0.35 * strength

    def step(self, s: Situation) -> Change:
        angle, soft = float(s.angle[s.axis]), math.tanh(float(s.rate[s.axis]) / 0.08)
        torque = 0.0
        for place, depth in self.DENTS:
            x = (angle - place) / 0.045
            bell = depth * math.exp(-0.5 * x * x)
            torque -= self.pull * 1.6487 * x * bell + self.slip * bell * soft
        change = Change()
        change.torque[s.axis] = torque
        return change


class ForkDraggedPot:
    """The rig's angle potentiometer, driven by a fork with play, and stiff to turn.

    The pin has a free way of ±b in the fork; at its ends it bends elastically (stiffness k) and
    takes the wiper (angle y) along, which holds with its Coulomb friction F and then turns against
    the damping paste c:
        P = k·dz(θ - y, b);   dy/dt = (P - F·sgn P)/c  if |P| > F, else 0;   torque = -P
    (dz: dead zone). After a reversal there is no friction until the play has been crossed.
    Source: Nordin & Gutman, Controlling mechanical systems with backlash - a survey, Automatica 38
    (2002); Olsson et al., Friction models and friction compensation (1998). Felt here: most
    one-axis rigs measure their angle so, and the play is a tenth of the swing of ±0.25 rad.
    """

    def __init__(self, strength: float) -> None:
        self.k, self.hold, self.paste = 130.0 * strength, 1.1 * strength, 0.7 * strength
        self.y = 0.0

    def step(self, s: Situation) -> Change:
        x = float(s.angle[s.axis]) - self.y
        bent = x - 0.025 if x > 0.025 else (x + 0.025 if x < -0.025 else 0.0)
        push = self.k * bent
        if abs(push) > self.hold:
            self.y += s.dt * (push - math.copysign(self.hold, push)) / self.paste
        change = Change()
        change.torque[s.axis] = -push
        return change


class LoadedBearingFriction:
    """Dry friction of the rig's pivot: LuGre with Stribeck peak, under a load that the lift
    relieves.

    z' = v - s0 |v| z / g(v),  g = N (Fc + (Fs-Fc) exp(-(v/vs)^2)),  torque = -(s0 z + s1 z'
    exp(-(v/vd)^2)).
    N: the pivot carries the weight of craft and frame less the rotors' lift, so it sticks more
    at low throttle.
    Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40 (1995); Armstrong-Helouvry 1994 (load).
    Felt: the axis reverses with every reference step and passes through stiction each time.
    """

    def __init__(self, strength):
        self.k, self.z = strength, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        v = float(s.rate[s.axis])
        lift = float(s.speed.sum()) * 0.5
        load = 0.3 + 0.7 * abs(1.6 - lift * math.cos(float(s.angle[s.axis]))) / 0.6
        g = load * (0.75 + 0.55 * math.exp(-(v / 0.12) ** 2))
        old = self.z
        self.z = (old + s.dt * v) / (1.0 + s.dt * 400.0 * abs(v) / g)
        slide = (self.z - old) / s.dt
        c.torque[s.axis] = -self.k * (400.0 * self.z + 5.0 * slide * math.exp(-(v / 0.3) ** 2))
        return c


class GearBacklash:
    """An eddy-brake and encoder wheel geared to the axis with play between the teeth.

    Two inertias and a dead zone: d = th - th2, contact where |d| > b, Hunt-Crossley tooth force
    T = k (|d|-b) (1 + x d') >= 0;  J2 th2'' = T - d2 th2' - m2 tanh(th2'/e).  The axis receives
    -T.
    Nordin & Gutman, Automatica 38 (2002); Hunt & Crossley, J. Appl. Mech. 42 (1975).
    Felt: at each reversal the wheel coasts freely, then its inertia and drag come back with a
    knock.
    """

    def __init__(self, strength):
        self.k, self.at, self.v2 = strength, None, 0.0

    def step(self, s: Situation) -> Change:
        c = Change()
        th, v = float(s.angle[s.axis]), float(s.rate[s.axis])
        if self.at is None:
            self.at = th
        h, total = s.dt / 2, 0.0
        for i in range(2):
            d = th + v * h * i - self.at
            dv = v - self.v2
            deep = abs(d) - 0.025
            force = 0.0
            if deep > 0.0:
                side = 1.0 if d > 0.0 else -1.0
                force = side * 350.0 * deep * max(0.0, 1.0 + 1.2 * side * dv)
            total += 0.5 * force
            self.v2 += h * (force - 0.55 * self.v2 - 0.15 * math.tanh(self.v2 / 0.05)) / 0.14
            self.at += h * self.v2
        c.torque[s.axis] = -self.k * total
        return c


class ThixotropicGreaseAgain:
    """Drag of a grease-packed gimbal bearing: shear-thinning, its structure broken by motion,
    rebuilt at rest.

    torque = -l K v / (v^2 + e^2)^((1-n)/2),  l' = (1-l)/tr - kb |v| l   (n = 0.35).
    Herschel-Bulkley/Ostwald power law with Moore's structural kinetics: Barnes, J. Non-Newt.
    Fluid Mech. 70
    (1997); Lugt, Grease Lubrication in Rolling Bearings (2013).
    Felt: after a second of calm the first movement is heavy, then it eases as the grease is
    worked.
    """

    def __init__(self, strength):
        self.k, self.l = strength, 1.0

    def step(self, s: Situation) -> Change:
        c = Change()
        v = float(s.rate[s.axis])
        self.l = (self.l + s.dt / 1.4) / (1.0 + s.dt * (1.0 / 1.4 + 4.0 * abs(v)))
        c.torque[s.axis] = -self.k * 4.4 * self.l * v * (v * v + 0.0016) ** -0.325
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


class PivotBearingStiction:
    """Dirt and dried grease in the pivot of the rig: it holds, tears loose, then rubs.

    A mechanic says: gritty, dry rig bearing; "it sticks and then jumps".
    Source: LuGre model, Canudas de Wit et al., IEEE TAC 40 (1995): bristles of stiffness s0,
    g(v) = Fc + (Fs - Fc) exp(-(v/vs)²), dz/dt = v - s0 |v| z / g(v), F = s0 z + s1 dz/dt.
    Felt: the frame stays where you leave it; it takes a push to start, less to keep it going.
    """

    def __init__(self, strength: float) -> None:
        self.coulomb = 0.011 * strength / INERTIA  # 11 mN m of rubbing
        self.static = 0.016 * strength / INERTIA  # 16 mN m to tear loose
        self.stribeck = 0.06  # rad/s
        self.s0 = self.static / 0.005  # tears loose after 5 mrad
        self.s1 = 0.4
        self.z = 0.0

    def step(self, s: Situation) -> Change:
        v = float(s.rate[s.axis])
        level = self.coulomb + (self.static - self.coulomb) * math.exp(-((v / self.stribeck) ** 2))
        before = self.z
        if abs(v) > 1e-12:
            # exact over the millisecond, for constant v
            end = math.copysign(level / self.s0, v)
            self.z = end + (before - end) * math.exp(-self.s0 * abs(v) * s.dt / level)
        change = Change()
        change.torque[s.axis] = -(self.s0 * 0.5 * (before + self.z)
                                  + self.s1 * (self.z - before) / s.dt)
        return change


class BrinelledBearing:
    """Balls of the rig's bearing rest in dents that a long drive has hammered into the race.

    A mechanic says: dented bearing, the rig clicks into one position since the drive in the van.

    False brinelling (Harris & Kotzalas, Rolling Bearing Analysis, ch. on failure; Brinell's
    indentation): each ball has to climb out of its dent of depth d under the load W, so that the
    energy W·d makes a well of the angle, U = -U0·exp(-((a - a0)/w)²/2), torque -dU/da. The van
    was parked with the rig slightly leaned. Felt: turned by hand the axis is free, but near one
    angle it snaps in and has to be pushed out of it.
    """

    PEAK = 6.0
    """rad/s², at strength 1."""
    CENTRE, WIDTH = 0.05, 0.05
    """rad"""

    def __init__(self, strength):
        self.peak = self.PEAK * strength

    def step(self, s: Situation) -> Change:
        x = (s.angle[s.axis] - self.CENTRE) / self.WIDTH
        change = Change()
        change.torque[s.axis] = -self.peak * x * math.exp(0.5 * (1.0 - x * x))
        return change


PLANTS = (
    Plant('thrust_relieved_bushing', ThrustRelievedBushing, 'bearings', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('thixotropic_grease', ThixotropicGrease, 'bearings', 1, rig=True),
    Plant('loaded_pivot_friction', LoadedPivotFriction, 'rigs', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('foam_stops', FoamStops, 'rigs', 1, rig=True, may_be=('cubic_stiffness',)),
    Plant('plain_bearing_lugre', PlainBearingLuGre, 'hinges', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('elastomer_hinge', ElastomerHinge, 'hinges', 1, rig=True,
          may_be=('pendulum_stiffness', 'cubic_stiffness')),
    Plant('payload_hinge_play', PayloadHingePlay, 'hinges', 2, rig=False,
          may_be=('pendulum_stiffness', 'resonance')),
    Plant('ball_bearing_prerolling', BallBearingPrerolling, 'joints', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('grease_thixotropy', GreaseThixotropy, 'joints', 1, rig=True,
          may_be=('coulomb_friction',)),
    Plant('bushing_under_thrust', BushingUnderThrust, 'joints', 2, rig=True,
          may_be=('coulomb_friction',)),
    Plant('loaded_bearing', LoadedBearing, 'gears', 0, rig=True, may_be=('coulomb_friction',)),
    Plant('gear_play', GearPlay, 'gears', 1, rig=True, may_be=('backlash', 'coulomb_friction')),
    Plant('shock_damper', ShockDamper, 'slings', 4, rig=True,
          may_be=('quadratic_drag', 'pendulum_stiffness')),
    Plant('sludgy_grease_gel', SludgyGreaseGel, 'greases', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('dented_race_valleys', DentedRaceValleys, 'greases', 1, rig=True,
          may_be=('coulomb_friction',)),
    Plant('fork_dragged_pot', ForkDraggedPot, 'greases', 2, rig=True,
          may_be=('coulomb_friction',)),
    Plant('loaded_bearing_friction', LoadedBearingFriction, 'governors', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('gear_backlash', GearBacklash, 'governors', 1, rig=True,
          may_be=('backlash', 'coulomb_friction')),
    Plant('thixotropic_grease_again', ThixotropicGreaseAgain, 'governors', 2, rig=True,
          may_be=('coulomb_friction',)),
    Plant('oil_damper', OilDamper, 'umbilicals', 5, rig=True,
          may_be=('quadratic_drag', 'pendulum_stiffness')),
    Plant('pivot_bearing_stiction', PivotBearingStiction, 'workshop', 0, rig=True,
          may_be=('coulomb_friction',)),
    Plant('brinelled_bearing', BrinelledBearing, 'field', 0, rig=True),
)
