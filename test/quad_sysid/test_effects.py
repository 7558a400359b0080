"""Every effect of the contract: its physics by another way, and whether it is found where it acts.

The flights come from the simulator of conftest.py, with each law written out here by hand. A law
is tested by evaluating a model with the true parameters: what is left is the noise. Discovery is
tested through `identify`: one effect planted, or nothing, and what is said of it; a second flight
that nobody has seen says what the answer is worth.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from flown_axis import DT, LONGER, SHORT, Axis, Plan, fly
from scipy.linalg import expm
from scipy.signal import lfilter

from quad_sysid.contract import MIXER, MIXER_INVERSE
from quad_sysid.discover.base import best_base
from quad_sysid.discover.constants import PRIOR_SIGMAS
from quad_sysid.discover.screen import candidates, screen
from quad_sysid.discover.search import _Search, extended
from quad_sysid.effects import EFFECTS
from quad_sysid.effects.curves import CELLS, COUNT, Curve, Smooth
from quad_sysid.effects.hidden import Shown
from quad_sysid.estimate.fit import Problem
from quad_sysid.estimate.stored import noise_of
from quad_sysid.model import EffectEstimate, Parameter
from quad_sysid.model.data import axis_data
from quad_sysid.model.effect import Effect, Part, Signals
from quad_sysid.model.flight import Flight
from quad_sysid.model.structure import Structure
from quad_sysid.pipeline import identify as pipeline
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.record import Record
from quad_sysid.report import document
from quad_sysid.report.missing_torque import Replay, over

GAIN, HALF_S = 450.0, 0.0005
"""The simulator asks for the torque every half millisecond."""
WARM = 0.002
"""Mean square of the commands that a memory counts as usual."""
PLAIN = {'unit': 1.0, 'rest': 0.0}
NOWHERE = Signals(*(np.zeros(1) for _ in range(7)), None, None, (np.zeros(1),) * 2, np.zeros(1))
NO_MORE = {f'c{i}': 0.0 for i in range(2, 8)}
KNOTS = (0.3, 0.38, 0.46, 0.54, 0.62, 0.7)
QUIET = {'gyro_noise': 0.004, 'torque_noise': 0.02}

Changes = Callable[[], Mapping[str, object]]


def torque(law: Callable[[float, float, float], float]) -> Changes:
    return lambda: {'torque': law}


def command(law: Callable[[float], float], **others: object) -> Changes:
    return lambda: {'command': lambda _t, u, _v: law(u), **others}


def others(t):
    """Rates of pitch and yaw, rad/s."""
    return 2.0 * np.sin(3.0 * t), 1.5 * np.cos(5.0 * t)


def other_commands(t):
    return 0.06 * np.sin(4.0 * t), 0.05 * np.cos(2.3 * t)


def throttle(t):
    return 0.5 + 0.1 * np.sin(0.9 * t)


def of_motors(law: Callable[[np.ndarray], np.ndarray], scale: float = 1.0) -> Changes:
    """A law of the single motors, through the mixer and back."""

    def given(t: float, u: float, _volts: float) -> float:
        motors = MIXER @ np.array([throttle(t), u, *other_commands(t)])
        return scale * float(MIXER_INVERSE[1] @ law(motors))

    return lambda: {'command': given, 'throttle': throttle, 'other_commands': other_commands}


def in_steps(step: float, level: float, hysteresis: float = 0.0) -> Changes:
    """Motors that take whole steps from a level, and keep one until half of a step and more."""

    def changes():
        kept = np.zeros(4)

        def taken(m):
            leave = np.abs((m - level) / step - kept) > 0.5 + hysteresis
            kept[leave] = np.round((m - level) / step)[leave]
            return level + kept * step

        return of_motors(taken)()

    return changes


def stateful(law: Callable[[float, float], float]) -> Callable[[float], float]:
    """A law of its own last value and what comes in."""
    state = [0.0]

    def following(value: float) -> float:
        state[0] = law(state[0], value)
        return state[0]

    return following


def play(half_width: float) -> Changes:
    def changes():
        loose = stateful(lambda held, u: min(max(held, u - half_width), u + half_width))
        return {'command': lambda _t, u, _v: loose(u)}

    return changes


def sent_on(make: Callable[[], Callable[..., float]], share: float = 1.0) -> Changes:
    """A torque law(t, rate, angle, u) of the command sent last; a share of that acts itself."""

    def changes():
        law, sent = make(), [0.0]

        def given(_t, u, _v):
            sent[0] = u
            return share * u

        return {'command': given, 'torque': lambda *now: law(*now, sent[0])}

    return changes


def pushed() -> Callable[[float], float]:
    return stateful(lambda x, u: x + HALF_S / Axis().lag_s * (u - x))


def slow_motors(share: float, slow_s: float) -> Changes:
    """A share of the drive comes through a lag of its own."""

    def make():
        late = stateful(lambda z, u: z + (u - z) * -math.expm1(-HALF_S / slow_s))
        return lambda _t, _rate, _angle, u: GAIN * share * late(u)

    return sent_on(make, 1.0 - share)


def ringing(frequency_hz: float, damping: float, in_phase: float, quadrature: float) -> Changes:
    """z'' + 2 d w z' + w² z = w² u beside the command."""

    def changes():
        w, state = 2.0 * math.pi * frequency_hz, [np.zeros(3)]  # z, z', u
        law = np.array([[0.0, 1.0, 0.0], [-w * w, -2.0 * damping * w, w * w], [0.0] * 3])
        step, out = expm(law * 0.004 / 20), np.array([in_phase, quadrature / w, 0.0])

        def given(_t, u, _v):
            state[0][2], total = u, 0.0
            for _ in range(20):
                total += 0.5 * out @ state[0]
                state[0] = step @ state[0]
                total += 0.5 * out @ state[0]
            return u + total / 20

        return {'command': given}

    return changes


def strap(stiffness: float, time_constant_s: float) -> Changes:
    """A viscous strap: a torque that follows the angle and forgets it."""

    def changes():
        pull = stateful(lambda z, rate: z + HALF_S * (-stiffness * rate - z / time_constant_s))
        return {'torque': lambda _t, rate, _angle: pull(rate)}

    return changes


def remembered(
    law: Callable[[float, float], float], torque_of: Callable[[float], float],
    time_constant_s: float,
) -> Changes:
    """A torque of what a law of time and angle says, behind a lag."""

    def changes():
        late = stateful(lambda x, now: x + HALF_S / time_constant_s * (now - x))
        return {'torque': lambda t, _rate, angle: torque_of(late(law(t, angle)))}

    return changes


def beyond_a_wind(change: float, time_constant_s: float) -> Changes:
    """A torque of what the angle has lately been, where that exceeds 0.06 rad."""
    return remembered(lambda _t, angle: angle, lambda x: change * math.copysign(
        max(abs(x) - 0.06, 0.0), x), time_constant_s)


def heated(change: float, time_constant_s: float) -> Changes:
    """A gain that falls as the motors' effort, behind their lag, heats them."""

    def changes():
        effort = stateful(lambda z, u: u + (z - u) * math.exp(-DT / Axis().lag_s))
        warm = stateful(lambda x, z: x + DT / time_constant_s * (z * z / WARM - x))
        return {'command': lambda _t, u, _v: u * (1.0 + change * (warm(effort(u)) - 1.0))}

    return changes


def lively(t):
    return 0.5 + 0.1 * np.sin(6.0 * t)


def shown(time_constant_s: float, motor: int) -> Changes:
    """A gyro that shows 0.05 P_2 of a motor's command behind a lag: as a torque, by the slope.

    P_2 is over half ranges of 0.08 about 0.5, constant beyond that range.
    """

    def make():
        x = 0.0

        def law(t, _rate, _angle, u):
            nonlocal x
            moving = (lively(t) + MIXER[motor, 1] * u - x) / time_constant_s
            x += HALF_S * moving
            z = (x - 0.5) / 0.08
            return 0.05 * 3.0 * z / 0.08 * moving if t > 0.5 and abs(z) < 1.1 else 0.0

        return law

    return lambda: {**sent_on(make)(), 'throttle': lively}


def dahl(size: float, build_up: float) -> Changes:
    """Friction that builds up over an angle, Dahl's law."""

    def changes():
        bristle = stateful(lambda z, rate: float(np.clip(
            z + rate * HALF_S / build_up * (1.0 - z * math.copysign(1.0, rate)), -1.0, 1.0)))
        return {'torque': lambda _t, rate, _angle: -size * bristle(rate)}

    return changes


def with_play(
    frequency_hz: float, damping: float, *, pull: float = 0.0, turns: float = 0.0,
    weight: float = 0.0, back: float = 0.0,
) -> Changes:
    """A load on a spring that hardens towards two stops; the lean pulls it, or a turn moves it.

    Its weight acts, and what its spring and damper push back.
    """

    def changes():
        z = own = 0.0

        def law(_t, rate, angle):
            nonlocal z, own
            v = own - turns * rate
            spring = (2.0 * math.pi * frequency_hz) ** 2 * z / max(1.0 - z * z, 0.02)
            push = -spring - damping * v
            v += HALF_S * (push - pull * math.sin(angle))
            z += HALF_S * v
            if abs(z) > 1.0:
                z, v = math.copysign(1.0, z), 0.0
            own = v + turns * rate
            return weight * z - back * push

        return {'torque': law}

    return changes


def behind_a_spring(frequency_hz: float, damping: float, reach: float, share: float) -> Changes:
    """A share of the drive comes through a spring that hardens towards two stops."""

    def make():
        behind, z, v = pushed(), 0.0, 0.0

        def law(_t, _rate, _angle, u):
            nonlocal z, v
            drive = GAIN * behind(u)
            spring = (2.0 * math.pi * frequency_hz) ** 2 * z / max(1.0 - z * z, 0.02)
            push = -spring - damping * v
            v += HALF_S * (push + drive / reach)
            z += HALF_S * v
            return -share * (drive + reach * push)

        return law

    return sent_on(make)


def by_cubic_law(
    moved: str, reach: float, time_constant_s: float, slope: float, lean: float, size: float
) -> Changes:
    """A torque of a state that flows off by a cubic law, which rate, angle or drive moves."""

    def make():
        behind, x = pushed(), 0.0

        def law(_t, rate, angle, u):
            nonlocal x
            drive = behind(u)
            now = {'leaning': angle, 'driven': drive, 'turning': time_constant_s * rate}[moved]
            x += HALF_S / time_constant_s * (now / reach - x * (slope + x * (lean + x)))
            return -size * x

        return law

    return sent_on(make)


def laguerre(first: float, second: float, time_constant_s: float) -> Changes:
    """A torque of the first two Laguerre states of the drive, x2 = (1 - s T) / (1 + s T) x1."""

    def make():
        behind = pushed()
        one, two = (stateful(lambda x, now: x + HALF_S / time_constant_s * (now - x))
                    for _ in range(2))

        def law(_t, _rate, _angle, u):
            x = one(GAIN * behind(u))
            return first * x + second * (x - 2.0 * two(x))

        return law

    return sent_on(make)


def drifting(seed: int, spread: float, correlation_s: float) -> Changes:
    """A gain that wanders: a first-order process with this RMS and correlation time."""
    keep = math.exp(-0.05 / correlation_s)
    white = np.random.default_rng(seed).standard_normal(2000)
    path = lfilter([spread * math.sqrt(1.0 - keep * keep)], [1.0, -keep], white)[200:].tolist()
    return lambda: {'command': lambda t, u, _v: u * (1.0 + path[int(20.0 * t)])}


def coasting(limit: float) -> Changes:
    """Propellers that slow down no faster than their drag stops them."""

    def changes():
        speeds = np.full(4, 0.5)

        def given(t, u, _v):
            nonlocal speeds
            asked = MIXER @ np.array([throttle(t), u, *other_commands(t)])
            away = asked - speeds
            slowed = speeds + away / np.sqrt(1.0 + np.minimum(away / limit, 0.0) ** 2)
            speeds = slowed + (speeds - slowed) * math.exp(-DT / Axis().lag_s)
            return float(MIXER_INVERSE[1] @ slowed)

        return {'command': given, 'throttle': throttle, 'other_commands': other_commands}

    return changes


def held(cycles: int) -> Changes:
    def changes():
        count, taken = 0, 0.0

        def given(_t, u, _v):
            nonlocal count, taken
            taken = taken if count % cycles else u
            count += 1
            return taken

        return {'command': given}

    return changes


def late_by(law: Callable[[float], float]) -> Changes:
    """A command that comes later by so many seconds, between samples by the share of each."""

    def changes():
        sent = []

        def given(t, u, _v):
            sent.append(u)
            whole, share = divmod(law(t) / DT, 1.0)
            older, newer = (sent[max(len(sent) - 1 - int(whole) - i, 0)] for i in (1, 0))
            return share * older + (1.0 - share) * newer

        return {'command': given}

    return changes


@dataclass(frozen=True)
class Law:
    """An effect, the plant that has it, and its parameters with the contract's units."""

    name: str
    changes: Changes
    parameters: Mapping[str, float]
    settings: Mapping[str, object] = field(default_factory=dict)
    variant: str = ''
    delay: float = 0.008
    """Of the base, with the mean of what the effect adds, s."""
    left: float = 0.002
    """rad/s that may be left over half a second: the noise, and what the steps differ by."""

    def __str__(self) -> str:
        return ' '.join([self.name, *map(str, self.parameters)])


LAWS = [
    Law('coulomb_friction', torque(lambda _t, r, _a: -0.8 * math.tanh(r / 0.004)),
        {'torque': 0.8, 'transition': 0.004}, left=0.003),
    Law('quadratic_drag', torque(lambda _t, r, _a: -1.5 * r * abs(r)), {'coefficient': 1.5}),
    Law('pendulum_stiffness', torque(lambda _t, _r, a: -4.0 * math.sin(a)), {'stiffness': 4.0}),
    Law('cubic_stiffness', torque(lambda _t, _r, a: -75.0 * a**3), {'stiffness': 75.0}),
    Law('dead_zone', command(lambda u: math.copysign(max(abs(u) - 0.004, 0.0), u)),
        {'half_width': 0.004}),
    Law('battery_sag',
        lambda: {'command': lambda _t, u, v: u * (v / 12.0) ** 2, 'volts': (12.9, 10.5)},
        {'exponent': 2.0}, {'reference_v': 12.0}),
    Law('thrust_curve', of_motors(lambda m: 0.5 * m + 0.5 * m**2), {'curvature': 0.5},
        {'throttle': 0.5}, left=0.003),
    Law('saturation', of_motors(lambda m: np.clip(m, 0.0, 0.64)),
        {'lower': 0.0, 'upper': 0.64}, variant='upper'),
    Law('motor_lag', slow_motors(0.25, 0.2), {'slow_time_constant': 0.2, 'share': 0.25}),
    Law('mode:lead', slow_motors(-0.4, 0.2), {'slow_time_constant': 0.2, 'share': 0.4}),
    Law('backlash', play(0.004), {'half_width': 0.004}),
    Law('resonance', ringing(6.0, 0.05, 0.1, -0.05),
        {'frequency': 6.0, 'damping_ratio': 0.05, 'in_phase': 0.1, 'quadrature': -0.05}),
    Law('cross_axis_input',
        lambda: {'command': lambda t, u, _v: u + 0.1 * other_commands(t)[0],
                 'other_commands': other_commands},
        {'fraction': 0.1}, {'other': 'pitch'}, 'other axis 1'),
    Law('gyroscopic_coupling',
        lambda: {'torque': lambda t, _r, _a: -0.6 * others(t)[1], 'other_rates': others},
        {'coefficient': -0.6}, {'other': 'yaw'}, 'other axis 2'),
    Law('inertia_coupling',
        lambda: {'torque': lambda t, _r, _a: 0.5 * others(t)[0] * others(t)[1],
                 'other_rates': others},
        {'coefficient': 0.5}),
    Law('periodic_disturbance',
        torque(lambda t, _r, _a: 0.8 * math.sin(2.0 * math.pi * 2.3 * t + 0.7)),
        {'amplitude': 0.8, 'frequency': 2.3, 'phase': 0.0}),
    Law('step_event', command(lambda u: 0.7 * u), {'time': 20.0, 'change': -0.3},
        variant='gain'),
    Law('step_event', torque(lambda *_: 0.8), {'time': 20.0, 'torque': 0.8},
        variant='torque'),
    Law('mode:slow_state', strap(9.0, 0.6), {'stiffness': 9.0, 'time_constant': 0.6}),
    Law('shape:angle', remembered(lambda _t, angle: angle, lambda x: -9.0 * x, 0.6),
        {'time_constant': 0.6, 'change': -9.0}, PLAIN, variant='memory'),
    Law('shape:angle', beyond_a_wind(-9.0, 0.6),
        {'time_constant': 0.6, 'y0': 2.16, 'y1': 1.08, 'y2': 0.0, 'y3': 0.0, 'y4': -1.08,
         'y5': -2.16},
        {**PLAIN, 'knots': (-0.3, -0.18, -0.06, 0.06, 0.18, 0.3), 'mean': (0.0,) * 6},
        variant='memory curve'),
    Law('shape:other_angle',
        lambda: {**remembered(lambda t, _: 2.0 / 3.0 * (1.0 - math.cos(3.0 * t)),
                              lambda x: 1.5 * x, 0.6)(),
                 'other_rates': others},
        {'time_constant': 0.6, 'change': 1.5}, PLAIN, variant='memory 1'),
    Law('shape:gain:command', heated(-0.3, 3.0), {'time_constant': 3.0, 'change': -0.3},
        {'unit': WARM, 'rest': 0.0}, variant='memory'),
    Law('shape:gain:time',
        lambda: {'command': lambda t, u, _v: u * (1.0 + 0.4 * math.sin(2.0 * t + 0.7))},
        {'amplitude': 0.4, 'frequency': 1.0 / math.pi, 'phase': 0.0}, variant='periodic',
        left=0.006),  # it swings before the lag here, behind it in the model
    Law('shape:delay:time', held(5), {'frequency': 50.0, 'phase': 0.0}, variant='held',
        delay=0.008 + 0.5 * (0.02 - DT)),
    Law('shape:delay:time',
        late_by(lambda t: 0.02 + 0.012 * math.sin(5.0 * t) + 0.006 * math.cos(10.0 * t)),
        {'frequency': 2.5 / math.pi, 'sine_1': 0.012, 'cosine_2': 0.006,
         **{f'{wave}_{k}': 0.0 for k in range(1, 7) for wave in ('sine', 'cosine')
            if (wave, k) not in (('sine', 1), ('cosine', 2))}},
        variant='periodic', delay=0.028),
    Law('shape:angle', torque(lambda _t, _r, a: 0.8 * math.sin(60.0 * a + 0.5)),
        {'waves': 60.0, 'cosine': 0.8 * math.sin(0.5), 'sine': 0.8 * math.cos(0.5)},
        variant='periodic', left=0.003),
    Law('shape:throttle', shown(0.03, motor=2),
        {'time_constant': 0.03, **{
            f'motor_{i}_{k}': 0.05 * ((i, k) == (3, 2)) for i in range(1, 5) for k in range(1, 5)
        }}, {'middle': 0.5, 'half': 0.08, 'dt': DT}, variant='shown by the gyro',
        left=0.006),  # the motors' delay counts here, in the model it does not
    Law('mode:hysteresis', dahl(0.4, 0.05), {'torque': 0.4, 'reach': 0.05}),
    Law('mode:loose_load', with_play(0.5, 3.0, pull=60.0, weight=2.0),
        {'frequency': 0.5, 'damping': 3.0, 'pull': 60.0, 'weight': 2.0, 'inertia': 0.0},
        variant='leaning', left=0.01),
    Law('mode:loose_load', with_play(1.0, 4.0, turns=1.0 / 0.3, back=0.4 * 0.3),
        {'frequency': 1.0, 'damping': 4.0, 'reach': 0.3, 'weight': 0.0, 'inertia': 0.4},
        variant='turning', left=0.006),
    Law('mode:soft_mount', behind_a_spring(6.0, 20.0, 0.02, 0.5),
        {'frequency': 6.0, 'damping': 20.0, 'reach': 0.02, 'weight': 0.0, 'inertia': 0.5},
        left=0.01),
    *(Law('mode:yielding', by_cubic_law(moved, *values),
          dict(zip(('reach', 'time_constant', 'slope', 'lean', 'torque'), values, strict=True)),
          variant=moved, left=0.006)
      for moved, *values in (('turning', 0.1, 0.3, 0.2, 0.5, 0.8),
                             ('leaning', 0.05, 0.3, -1.0, 0.0, 0.8),
                             ('driven', 0.01, 0.1, 1.0, -1.5, 0.8))),
    Law('mode:response', laguerre(0.3, -0.2, 0.2),
        {'time_constant': 0.2, 'c0': 0.3, 'c1': -0.2, **NO_MORE},
        left=0.003),
    *(Law('shape:gain:command', in_steps(0.0213, 0.4969, hysteresis),
          {'step': 0.0213, 'level': -0.0031 / 0.0213, 'hysteresis': hysteresis}, variant='steps',
          left=0.01) for hysteresis in (0.0, 0.3)),
    Law('shape:gain:command', of_motors(lambda m: m + 0.5 * (m - 0.5) ** 2),
        {f'slope_{i}': x - 0.5 for i, x in enumerate(KNOTS)},
        {'knots': KNOTS, 'mean': (0.0,) * 6, 'throttle': 0.5}, 'smooth, motors', left=0.003),
    Law('shape:gain:command', of_motors(lambda m: m - np.array([0.0, 0.3, 0.0, 0.0]) * (m - 0.5)),
        {f'slope_{i}': -0.3 for i in range(6)},
        {'knots': KNOTS, 'mean': (0.0,) * 6, 'throttle': 0.5}, 'smooth, motor 2', left=0.003),
]
"""On another flight the values after an event hold, and a disturbance has a phase of its own."""


@pytest.fixture(scope='module')
def calm_flights():
    """A function: 13 s of an axis with hardly any noise."""
    plan = Plan(14.0, (('validation', 'prbs', 1.0, 14.0),))
    calm = {'gyro_noise': 0.0005, 'torque_noise': 0.0}
    return lambda changes: fly(Axis(**{**calm, **changes}), 3, plan)


@pytest.fixture(scope='module')
def empty_flight(calm_flights):
    """Everything moves that an effect may need, and nothing acts."""
    return calm_flights({
        'throttle': throttle, 'other_rates': others, 'other_commands': other_commands,
        'volts': (12.9, 10.5),
    })


@pytest.mark.parametrize('law', LAWS, ids=str)
def test_the_true_effect_leaves_the_noise_and_spoils_a_flight_without_it(
    law, true_model, calm_flights, empty_flight
):
    parameters = tuple(Parameter(n, v, None, '') for n, v in law.parameters.items())
    effect = EffectEstimate(law.name, 'named', (), parameters, law.variant, law.settings)
    base = tuple(replace(p, value=law.delay) if p.name == 'delay' else p for p in true_model.base)
    model = replace(true_model, base=base, effects=(effect,), plain=true_model.base)
    there, absent = (evaluate(model, r) for r in (calm_flights(law.changes()), empty_flight))
    assert there.after < law.left
    assert there.before > 5.0 * there.after
    assert absent.before < 0.002
    assert absent.after > 5.0 * absent.before


@pytest.mark.parametrize(('name', 'lost'), [('pendulum_stiffness', [0, 1, 2]),
                                            ('shape:other_angle', [1, 2])])
def test_a_model_is_refused_on_a_flight_without_a_signal_that_it_needs(
    name, lost, true_model, empty_flight, refusal
):
    law = next(law for law in LAWS if law.name == name)
    parameters = tuple(Parameter(n, v, None, '') for n, v in law.parameters.items())
    effect = EffectEstimate(law.name, 'named', (), parameters, law.variant, law.settings)
    angles = empty_flight.angles.copy()
    angles[:, lost] = np.nan
    model, blind = replace(true_model, effects=(effect,)), replace(empty_flight, angles=angles)
    assert f'{name} of the model needs' in refusal(evaluate, model, blind)


def test_near_the_ground_thrust_at_most_doubles():
    """Where the law of a single source would let it grow without bounds."""
    ground = next(e for e in EFFECTS if e.name == 'ground_effect')
    height = np.array([0.01, 0.1, 0.2, 0.3, 0.6, 2.0])
    s = Signals.at_rest(0.0 * height, 0.0 * height, angle=height, drive=np.full(6, 9.81))
    for radius in (0.3, 1.0, 2.0):
        gained = ground.torque(s, np.array([(0.25 * radius) ** 2, 0.2]), {'lowest': 0.2}) / 9.81
        assert (np.diff(gained) <= 0.0).all()
        assert gained.max() <= 1.0
        far = height > 0.36 * radius
        law = 1.0 / (1.0 - (0.25 * radius / height[far]) ** 2) - 1.0
        np.testing.assert_allclose(gained[far & (height >= 0.1)], law[height[far] >= 0.1])
    farming = (0.25 * 1.4) ** 2  # four propellers of 54 inches
    assert farming < 0.6 * PRIOR_SIGMAS * ground.parameters[0].spread


def test_a_memory_begins_with_its_flight_whatever_part_of_it_is_fitted_or_judged():
    plan = Plan(24.0, (('train', 'prbs', 4.0, 9.0), ('train', 'prbs', 13.0, 18.0),
                       ('validation', 'prbs', 19.0, 24.0)))
    flights = [fly(Axis(throttle=throttle, other_rates=others), seed, plan) for seed in (1, 2)]
    lost = [f.rates.copy() for f in flights]
    for rates in lost:
        rates[round(11.0 / DT) : round(11.5 / DT)] = np.nan
    torn = axis_data([replace(f, rates=r) for f, r in zip(flights, lost, strict=True)], 'roll')
    whole = axis_data(flights, 'roll')
    memories = [effect for effect in EFFECTS if effect.variant.startswith('memory')]
    assert len(memories) > 10
    for effect in memories:
        part = Part(effect, effect.prepare(whole))
        structure, p = Structure((part,)), np.array([GAIN, 0.042, 0.008, 0.4, 0.2, 6.0, 0.1])

        def remembered_in(flight, part=part, structure=structure, p=p):
            s = flight.signals(structure, p, flight.rate)
            return flight.hidden(part, s, p[5:]).hidden[0]

        truth = remembered_in(Flight(whole, whole.stretches))
        for problem in (Problem(torn, torn.train), Problem(torn, torn.validation, whole=True)):
            at = np.arange(truth.size) if problem.data.source is None else problem.data.source[1]
            inside = np.concatenate([np.arange(a, b) for a, b in problem.spans])
            found = remembered_in(problem.flight)[inside]
            assert found == pytest.approx(truth[at[inside]], abs=0.1), effect


def test_a_curve_over_time_begins_anew_with_each_flight():
    """As it does in a flight that it has never seen."""
    def warming(t, u, _volts):
        return u * (1.3 - 0.3 * min(t / 15.0, 1.0) ** 2)

    flights = [fly(Axis(command=warming), seed, LONGER) for seed in (1, 2)]
    data = axis_data(flights, 'roll')
    problem = Problem(data, data.train)
    problem.measure(base := best_base(problem))
    parts, _ = candidates(problem, [e for e in EFFECTS if e.label == 'shape:gain:time/smooth'])
    knots = np.array(parts[0].settings['knots'])
    assert 1.0 < knots[0] < knots[-1] < 18.0
    found = extended(problem, base, screen(problem, base, parts)[0]).values[5:11]
    np.testing.assert_allclose(found - found[-1], 0.3 - 0.3 * np.minimum(knots / 15.0, 1.0) ** 2,
                               atol=0.05)


def test_a_gain_that_wanders_is_drawn_over_all_flights_one_after_another():
    data = axis_data([fly(Axis(), seed, SHORT) for seed in (1, 2)], 'roll')
    problem = Problem(data, data.train)
    problem.measure(base := best_base(problem))
    drawn = {}
    for how in ('wandering', 'smooth'):
        label = f'shape:gain:time/{how}'
        parts, _ = candidates(problem, [e for e in EFFECTS if e.label == label])
        structure = Structure(tuple(parts))
        theta = np.insert(base.theta, 5, np.zeros(structure.slices[0].stop - 5))
        shown = replace(base, structure=structure, theta=theta)
        drawn[how] = over(Replay(problem, shown), parts[0]).values
    assert (np.diff(drawn['wandering']) >= 0.0).all()
    assert drawn['smooth'].max() < 21.0
    assert drawn['wandering'].max() > 30.0


@pytest.mark.parametrize('axis', ['climb', 'surge'])
def test_what_leans_is_no_candidate_where_metres_stand_for_the_angle(plain_flight, axis):
    data = replace(axis_data([plain_flight], 'roll'), axis=axis)
    parts, _ = candidates(Problem(data, data.train), EFFECTS)
    assert not {'pendulum_stiffness', 'mode:loose_load/leaning', 'gyroscopic_coupling'} & {
        word for part in parts for word in (part.effect.name, part.effect.label)}


def test_a_curve_holds_its_last_value_outside_the_training():
    """The slope at the end of a curve says nothing about what follows."""
    knots = np.linspace(-0.3, 0.3, 6)
    settings = {'knots': tuple(knots), 'mean': (0.0,) * 6}
    angle = np.array([0.27, 0.3, 0.36, 1.0])
    curve = Curve('torque', 'angle')
    out = curve.torque(replace(NOWHERE, rate=0.0 * angle, angle=angle), 5.0 * knots, settings)
    np.testing.assert_allclose(out, [1.35, 1.5, 1.5, 1.5])


# found where it acts


def law_of(name: str, parameter: str) -> Changes:
    return next(law.changes for law in LAWS if law.name == name and parameter in law.parameters)


def coloured(seed: int, bandwidth_hz: float, intensity: float) -> Changes:
    """White torque noise, (rad/s²)/√Hz, behind a first-order lag."""

    def changes():
        rng, keep = np.random.default_rng(seed), math.exp(-2.0 * math.pi * bandwidth_hz * HALF_S)
        lag = stateful(lambda z, white: white + (z - white) * keep)
        size = intensity / math.sqrt(HALF_S)
        return {'torque': lambda *_: lag(size * rng.standard_normal()), 'torque_noise': 0.0}

    return changes


RIVALS = (
    'coulomb_friction', 'quadratic_drag', 'pendulum_stiffness', 'dead_zone', 'backlash',
    'motor_lag', 'resonance', 'mode:slow_state', 'mode:yielding/turning', 'shape:rate/smooth',
    'shape:angle/smooth', 'shape:command/smooth', 'shape:gain:command/smooth',
    'shape:delay:time/smooth',
)
"""What an effect is told from here."""


ANOTHER = Plan(16.0, (('idle', 'none', 0.0, 1.0), ('validation', 'prbs', 1.0, 16.0)))


@dataclass(frozen=True)
class Planted:
    """A plant, the effect that must be named, and what its parameters must be."""

    changes: Changes
    label: str
    """Of the effect that explains most; a variant may be left open."""
    lowers: float
    """By which factor the error of an unseen flight falls."""
    truths: tuple = ()
    """(value, relative tolerance, absolute tolerance) of its first parameters."""
    alone: bool = True
    """Whether it is all that is found."""
    plan: Plan = SHORT
    quick: bool = True
    """Whether it is flown outside of `make test-long`."""

    def __str__(self) -> str:
        return self.label


STEP = 0.0213
PLANTED = [
    Planted(law_of('dead_zone', 'half_width'), 'dead_zone', 4.0, ((0.004, 0.10, 0.0),)),
    Planted(strap(3.6, 0.8), 'mode:slow_state', 1.5, ((0.8, 0.6, 0.0), (3.6, 0.3, 0.0)),
            plan=LONGER),
    Planted(held(5), 'shape:delay:time/held', 3.0, ((50.0, 1e-3, 0.0),), alone=False,
            plan=LONGER),
    Planted(in_steps(STEP, 0.4969), 'shape:gain:command/steps', 3.0,
            ((STEP, 0.005, 0.0), (-0.0031 / STEP, 0.0, 0.05), (0.0, 0.0, 0.05))),
    # propellers that coast, by how far they have to go
    Planted(coasting(0.03), 'shape:lag:direction', 3.0, alone=False),
    # what begins beyond an airspeed: a curve of what the angle has lately been
    Planted(beyond_a_wind(-20.0, 0.4), 'shape:angle/memory curve', 3.0,
            ((0.4, 0.3, 0.0),)),
    # gusts of the axis' own beside what another axis' command does to it
    Planted(lambda: {**coloured(6, 3.0, 0.05)(), 'other_commands': other_commands,
                     'command': lambda t, u, _v: u + 0.15 * other_commands(t)[0]},
            'cross_axis_input', 1.5, ((0.15, 0.0, 0.02),), quick=False),
]


def only(*labels: str) -> tuple[Effect, ...]:
    return tuple(e for e in EFFECTS if e.label in labels)


def answer_of(record: Record, **options):
    """Without the black-box models, which say nothing of effects."""
    with mock.patch.object(pipeline, '_black_boxes', return_value='left out'):
        return pipeline.identify([record], pipeline.Options(axes=('roll',), **options))['roll']


def answer_to(changes: Changes, seed: int, *, plan: Plan = SHORT, **options):
    return answer_of(fly(Axis(**{**QUIET, **changes()}), seed, plan), **options)


def unseen(answer, changes: Changes, seed: int = 501):
    """The errors of its model in another flight, of the base and with what was found."""
    return evaluate(answer.model, fly(Axis(**{**QUIET, **changes()}), seed, ANOTHER))


def check_values_of(effect, truths) -> None:
    for found, (truth, rel, within) in zip(effect.parameters, truths, strict=False):
        assert found.value == pytest.approx(truth, rel=rel, abs=within), found
        assert rel < 0.05 or abs(found.value - truth) < 4.0 * found.std


def check_sure_of(effect) -> None:
    assert 0.0 <= effect.p_value < 0.05
    assert effect.error_reduction_pct > 0.0
    assert effect.probability > 0.5
    total = effect.probability + sum(p for _, p in effect.rivals)
    assert total == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize('one', [
    pytest.param(one, marks=[] if one.quick else pytest.mark.long) for one in PLANTED], ids=str)
def test_what_acts_is_named_measured_and_foreseen_in_another_flight(one):
    """One of each kind; bench/effects.py plants all that are named, and pairs, among all."""
    answer = answer_to(one.changes, 1, plan=one.plan, effects=tuple(
        e for e in EFFECTS if e.label in RIVALS or e.label.startswith(one.label)))
    assert answer.verdict == 'effects_added', answer.reason
    effects = answer.model.effects
    effect = max(effects, key=lambda e: e.error_reduction_pct)
    assert f'{effect.name}/{effect.variant}'.startswith(one.label)
    check_values_of(effect, one.truths)
    if one.truths:
        check_sure_of(effect)
    if one.alone:
        assert effects == (effect,)
        assert answer.model.value('gain') == pytest.approx(GAIN, rel=0.05)
    errors = unseen(answer, one.changes)
    assert errors.before > one.lowers * errors.after


def test_friction_is_named_and_measured_among_all_effects(rubbed_answer):
    (effect,) = rubbed_answer.model.effects
    assert effect.name == 'coulomb_friction'
    check_values_of(effect, ((0.8, 0.10, 0.0),))
    check_sure_of(effect)
    errors = unseen(rubbed_answer, law_of('coulomb_friction', 'torque'))
    assert errors.before > 4.0 * errors.after


def test_a_step_of_torque_does_not_hide_the_friction_beside_it():
    """The disturbance holds the step in a later flight, where the friction does the harm."""
    def changes():
        return {'torque': lambda t, r, _a: 1.2 * (t > 13.5) - 0.32 * math.tanh(r / 0.02),
                'torque_noise': 0.03, 'gyro_noise': 0.005}

    both = only('step_event/torque', 'coulomb_friction')
    step, friction = answer_to(changes, 1, plan=LONGER, effects=both).model.effects
    assert (step.name, friction.name) == ('step_event', 'coulomb_friction')
    check_values_of(friction, ((0.32, 0.10, 0.0),))


def test_a_motor_that_loses_thrust_late_in_the_training_is_an_event():
    def changes():
        return {'torque': lambda t, *_: -3.0 * (t > 10.5),
                'command': lambda t, u, _v: u * (1.0 - 0.12 * (t > 10.5))}

    events = only('step_event/torque', 'step_event/gain', 'shape:gain:time/smooth')
    told = answer_to(changes, 1, effects=events).findings
    assert told.ladder.rungs[1].labels == ('step_event/torque',)
    # an interleaved third knows it; of the torque the disturbance holds what is steady
    assert told.ladder.rungs[1].explains_pct > 80.0
    assert {*told.ladder.rungs[2].labels} == {'step_event/torque', 'step_event/gain'}
    assert told.ladder.answer == 2
    # the two are found also where a curve came before the second
    search = _Search(told.problem, candidates(told.problem, events)[0], told.search.base,
                     lambda: '', lambda _: None)
    fitted = told.search.base
    for label in ('step_event/torque', 'shape:gain:time/smooth'):
        score = next(one for one in search.scores(fitted, all_candidates=True)
                     if one.part.effect.label == label)
        # a copy, as another process returns it
        fitted = search.store(deepcopy(extended(told.problem, fitted, score))).fit
    assert search.best().fit is fitted
    # beside the first alone it had ended at a lower maximum
    alone = frozenset({'step_event/torque'})
    reached = search.known[alone].score
    search.known[alone] = replace(search.known[alone], score=reached - 50.0)
    assert not search.spare()
    assert search.known[alone].score == pytest.approx(reached, abs=1.0)
    assert search.exchange()
    assert {*search.best().fit.structure.labels} == {'step_event/torque', 'step_event/gain'}
    with mock.patch.object(search, 'build_on') as build_on:  # beside what it led to, and once
        assert not search.add()
        search.built.add(frozenset(search.best().fit.structure.labels))
        assert not search.add()
    build_on.assert_called_once_with([search.best()])
    # and once beside an effect that changes next to nothing
    search = _Search(told.problem, candidates(told.problem, events)[0], told.search.base,
                     lambda: '', lambda _: None)
    with mock.patch.object(search, 'improves_little', return_value=True), \
            mock.patch.object(search, 'build_on', wraps=search.build_on) as build_on:
        search.run()
    assert build_on.call_count == 2


def test_a_base_whose_gain_drifts_misses_what_comes_later():
    flight = answer_to(lambda: {'command': lambda t, u, _: u * (1.0 - t / 150.0)}, 1,
                       effects=only('shape:gain:time/smooth'))
    ladder = flight.findings.ladder
    assert np.sum(ladder.drift) > 1.8 * ladder.rungs[0].total
    assert ladder.rungs[1].explains_pct > 99.0


def test_a_gain_that_wanders_is_followed_in_another_flight_on_its_own_path():
    answer = answer_to(drifting(1, 0.3, 5.0), 1,
                       effects=only('shape:gain:time/wandering', 'shape:gain:time/smooth'))
    (effect,) = answer.model.effects
    assert (effect.name, effect.variant) == ('shape:gain:time', 'wandering')
    found = {p.name: p.value for p in effect.parameters}
    assert 0.15 < found['spread'] < 0.6
    assert 1.0 < found['correlation'] < 25.0
    errors = unseen(answer, drifting(2, 0.3, 5.0))
    assert errors.before > 1.5 * errors.after
    plain = unseen(answer, dict, 502)
    assert plain.after < 1.1 * plain.before


def test_a_spring_that_swings_an_aircraft_whose_motors_stand_is_no_answer():
    """It foresees the rates well, and the commands nothing: their gain would be a guess."""
    swings = {'torque': lambda _t, _rate, angle: -20.0 * math.sin(angle), 'torque_noise': 0.2,
              'command': lambda *_: 0.0}
    answer = answer_to(lambda: swings, 1, effects=only('pendulum_stiffness'))
    assert (answer.verdict, answer.proposal.gains) == ('cannot_tell', None)
    assert 'commands do not predict' in answer.reason


def test_a_swinging_rig_is_foreseen_in_another_flight_without_a_measured_angle():
    """Commands hold for a second, the gyro is noisy: errors must not add up in the angle."""
    held = np.repeat(np.random.default_rng(4).uniform(-0.25, 0.25, 80), round(0.8 / DT))
    axis = Axis(torque=lambda _t, _rate, angle: -20.0 * math.sin(angle), gyro_noise=0.03)

    def flown(seed: int, plan: Plan) -> Record:
        plan = replace(plan, reference=held[:: 1 if seed == 1 else -1])
        return replace(fly(axis, seed, plan), angles=None)

    rivals = ('pendulum_stiffness', 'shape:angle', 'coulomb_friction', 'mode:slow_state',
              'mode:swinging')
    answer = answer_of(flown(1, SHORT), effects=tuple(e for e in EFFECTS if e.name in rivals))
    (spring,) = answer.model.effects
    assert (spring.name, spring.variant) == ('pendulum_stiffness', 'from the rate')
    stiffness = {p.name: p.value for p in spring.parameters}['stiffness']
    assert stiffness == pytest.approx(20.0, rel=0.05)
    errors = evaluate(answer.model, flown(2, ANOTHER))
    assert errors.before > 3.0 * errors.after


# nothing where nothing acts


@pytest.mark.parametrize(
    ('changes', 'seed'),
    [(coloured(3, 2.0, 0.05), 3), (lambda: {
        'throttle': throttle, 'other_rates': others, 'other_commands': other_commands,
        'volts': (12.6, 11.4)}, 2)],
    ids=['gusts of 2 Hz', 'everything else moves'],
)
def test_where_nothing_acts_nothing_is_found(changes, seed, monkeypatch):
    """bench/effects.py flies some hundred of them, test_nodes_go_on.py one in which all rests."""
    answer = answer_to(changes, seed)
    assert (answer.verdict, answer.model.effects) == ('no_missing_effect', ()), answer.reason
    assert 'gusts' not in answer.reason
    monkeypatch.setattr('quad_sysid.pipeline.identify.GUSTY', 0.5)
    noise = noise_of(answer.findings.verdict.base)
    assert f'gusts, {noise.disturbance_rms:.2g} rad/s²' in pipeline._reason(answer.findings, '')
    error = document.document({'roll': answer}, ['bag'])['axes']['roll']['error']
    assert error['after'] == pytest.approx(error['before'], rel=1e-12)


@pytest.mark.long
@pytest.mark.parametrize('changes', [
    torque(lambda t, *_: 1.2 if 12.0 <= t < 14.0 or 44.0 <= t < 46.0 else 0.0),
    lambda: {'command': lambda t, u, _v: 0.35 * u if 10 < t < 18 or 44 < t < 50 else u},
], ids=['a gust of 2 s', 'a motor that misses'])
def test_what_comes_twice_and_no_model_predicts_is_not_passed_over(changes):
    answer = answer_to(changes, 6, plan=Plan())
    assert answer.verdict in {'unexplained_residual', 'effects_added'}, answer.reason
    assert {e.name for e in answer.model.effects} <= {'event', 'step_event', 'shape:gain:time'}


def test_validation_does_not_touch_what_is_chosen(rubbed_flight):
    other = fly(Axis(**QUIET, **law_of('coulomb_friction', 'torque')()), 7, SHORT)
    cut = round(13.25 / other.dt)
    columns = ('rates', 'angles', 'control', 'battery_v', 'attitude_setpoint')
    mixed = replace(rubbed_flight, **{
        name: np.concatenate((getattr(rubbed_flight, name)[:cut], getattr(other, name)[cut:]))
        for name in columns
    })
    few = only('coulomb_friction', 'quadratic_drag')
    ours, another = (answer_of(flight, effects=few).model
                     for flight in (rubbed_flight, mixed))
    assert [e.name for e in ours.effects] == ['coulomb_friction']
    assert ours.base == another.base
    assert ours.effects[0].parameters == another.effects[0].parameters


def test_effects_that_the_data_cannot_show_are_left_out_and_told(plain_flight):
    bare = replace(plain_flight, angles=None, attitude_setpoint=None)
    reasons = {
        'pendulum_stiffness': 'the flight holds no orientation',
        'cubic_stiffness': 'the flight holds no orientation',
        'shape:angle': 'the flight holds no orientation',
        'battery_sag': 'the voltage moves by 0.000 V only',
        'thrust_curve': 'the throttle stays at 0.50',
        'cross_axis_input': 'hardly moves during training; excite it as well',
        'gyroscopic_coupling': 'hardly turns during training',
        'inertia_coupling': 'hardly turns during training',
    }
    few = [e for e in EFFECTS if e.name in {*reasons, 'coulomb_friction', 'quadratic_drag'}]
    answer = {'roll': answer_of(bare, effects=few)}
    tree = document.document(answer, ['bag'])['axes']['roll']
    told = {e['name'].partition('/')[0]: e['because'] for e in tree['not_tested']}
    for name, words in reasons.items():
        assert words in told[name], name
    labels = {item['name'] for item in tree['not_tested']}
    assert not {label for item in tree['tried'] for label in item['effects']} & labels
    rates = np.where([True, False, False], bare.rates, np.nan)
    data = axis_data([replace(bare, battery_v=None, rates=rates)], 'roll')
    why = {effect.name: effect.prepare(data) for effect in EFFECTS}
    assert why['battery_sag'] == 'the flight holds no battery voltage'
    unmeasured = axis_data([replace(bare, battery_v=np.zeros(bare.n))], 'roll')
    sag = next(effect for effect in EFFECTS if effect.name == 'battery_sag')
    assert 'moves by 0.000 V only' in sag.prepare(unmeasured)
    assert 'was not measured throughout' in why['gyroscopic_coupling']


def read(effect) -> dict[str, str]:
    """What a report reads of an effect: name to unit."""
    count = len(effect.parameters)
    settings = {'mean': (0.0,) * COUNT, 'unit': 1.0, 'lowest': 0.0}
    told = effect.readable(np.ones(count), settings)
    return {name: unit for name, (_, unit) in told.items()}


def test_the_contracts_names_stand_in_the_tables_of_the_pages_with_their_units():
    docs = Path(__file__).resolve().parents[2] / 'docs'
    rows, cells = {}, {}
    pages = (docs / name for name in ('what_is_missing.md', 'theory.md'))
    for line in (line for page in pages for line in page.read_text('utf-8').splitlines()):
        parts = [cell.strip() for cell in line.strip('|').split('|')]
        if len(parts) == 5 and parts[0].startswith('`'):
            rows[parts[0].strip('`')] = parts[2]
        elif len(parts) == 2 and parts[0] in CELLS:
            cells[parts[0]] = tuple(parts[1].split(', '))
    formed = [e for e in EFFECTS if not isinstance(e, (Smooth, Shown))]
    assert (cells, set(rows)) == (CELLS, {e.name for e in formed})
    named = {e.name for e in EFFECTS if e.kind == 'named'}
    # the lead of the rotors hides no state: it is a law as the named ones are
    assert named - {'mode:rotor_lead'} == {name for name in rows if ':' not in name} - {'event'}
    assert 'mode:rotor_lead' in named
    for name, told in rows.items():
        pairs = set(re.findall(r'`(\w+)` \(((?:[^()]|\([^()]*\))+)\)', told))
        assert pairs == {pair for e in formed if e.name == name for pair in read(e).items()}, name
