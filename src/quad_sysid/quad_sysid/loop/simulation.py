"""The closed loop over time: the cascade around a Plant or a polynomial model.

The plant's own laws, noted once as operations on numbers (model/traced.py), run in compiled code;
one that cannot be noted is called among them. The controller is that of kernels.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop import kernels
from quad_sysid.loop.cascade import CascadeGains, constants_of
from quad_sysid.loop.plant import Flying
from quad_sysid.model import AxisModel, laws
from quad_sysid.model.effect import Drive, Effect, Part, Signals, required
from quad_sysid.model.plant import Plant, State, alike, leaves
from quad_sysid.model.traced import Call, Listing, Untraceable, with_ends

OUTSIDE = ('throttle', 'battery_v', 'time', 'other_rates', 'other_commands', 'other_angles')
"""Fields of Signals that are known of a cycle whatever the loop does."""


class LoopResponse(NamedTuple):
    """(n,) each: measured angle (rad) and rate (rad/s) at the start of a cycle, outputs in it.

    control is the output of C2 (normalised command, the plant's input), rate_reference of C1
    (rad/s). (f, n) each for f flights.
    """

    angle: FloatArray
    rate: FloatArray
    control: FloatArray
    rate_reference: FloatArray


@dataclass(frozen=True)
class Program:
    """A plant's laws as compiled code takes them."""

    code: npt.NDArray[np.int64]
    more: npt.NDArray[np.int64]
    tables: FloatArray
    start: FloatArray
    places: kernels.Places
    row: FloatArray
    """(c,) as in Drive."""
    factors: FloatArray
    """(c, 2, k) as in Drive."""
    calls: Sequence[tuple[int, Call]]
    """Operations that are laws in Python: index in `code`, and the call."""

    @cached_property
    def kind(self) -> tuple[Any, ...]:
        """Key that is equal for plants that differ in numbers only."""
        return (self.code.tobytes(), self.more.tobytes(), self.tables.size, self.start.size,
                self.factors.shape, *(x if isinstance(x, int) else x.tobytes()
                                      for x in self.places))


LAWS = ('torque', 'command', 'actuate', 'advance')
NOWHERE, NOTHING = np.zeros(0, np.int64), np.zeros((0, 1, 1))
CHANNELS = ('commands', 'lag', 'ages', 'fraction')
"""What a law may change of a Drive from cycle to cycle."""


class _Traceable:
    """An effect whose laws are noted, or called where they cannot be: on a value's branch, say."""

    def __init__(self, effect: Effect, listing: Listing) -> None:
        self.effect, self.listing = effect, listing

    def __getattr__(self, name: str) -> Any:
        own = getattr(self.effect, name)
        return partial(self._trace, own) if name in LAWS else own

    def _trace(self, law: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return law(*arguments)
        except (Untraceable, TypeError, IndexError, ValueError):
            pass
        *first, s, p, settings = arguments
        tree = {'s': vars(s), 'first': tuple(
            vars(one) if isinstance(one, Drive) else one for one in first)}

        def ready(values: Any) -> Callable[[], Any]:
            own = [Drive(**x) if isinstance(x, dict) else x for x in values['first']]
            signals = Signals(**values['s'])
            return lambda: law(*own, signals, p, settings)

        def made(values: Any) -> Callable[[], Sequence[FloatArray]]:
            call = ready(values)
            return lambda: _arrays(call())

        with np.errstate(all='ignore'):
            sample: Any = ready(with_ends(tree, lambda one: np.ones(one.shape)))()
        if sample is None:
            return None
        results: list[Any] = self.listing.call(made, tree, _arrays(sample))
        return replace(sample, **dict(zip(CHANNELS, results, strict=True))) \
            if isinstance(sample, Drive) else results[0]


def _arrays(result: Any) -> list[FloatArray]:
    """What a law gives, as arrays."""
    return [np.asarray(one) for one in (
        [vars(result)[name] for name in CHANNELS] if isinstance(result, Drive) else [result])]


@lru_cache(maxsize=16)
def program(plant: Plant, known: tuple[bool, ...]) -> Program:
    """The operations of one cycle of a plant; `known`: which signals of OUTSIDE it has."""
    still = Signals.at_rest(np.zeros(1), np.zeros(1))
    one = replace(still, battery_v=np.zeros(1), sent=np.zeros(1))
    rest = plant.begin(plant.with_motors(one), np.zeros(1), np.zeros(1))
    listing = Listing()

    def with_notes(part: Part) -> Part:
        return replace(part, effect=cast('Effect', _Traceable(part.effect, listing)))

    own = plant.structure
    traced = replace(plant, structure=replace(
        own, law=own.law and with_notes(own.law), parts=tuple(map(with_notes, own.parts))))
    fields = {
        name: None if not there else (listing.inputs(1), listing.inputs(1))
        if name.startswith('other') else listing.inputs(1)
        for name, there in zip(OUTSIDE, known, strict=True)
    }
    sent, push, motors = listing.inputs(1), listing.inputs(1), listing.inputs(4, 1)
    first = len(listing.start)
    turning, hidden = (alike(x, lambda one: listing.inputs(*one.shape))
                       for x in (rest.turning, rest.hidden))
    s = plant.with_own(replace(still, **fields, sent=sent))  # type: ignore[arg-type]
    s = plant.with_motors(s)
    drive, after = traced.send(hidden, s)
    split = len(listing.code)
    later = traced.turn(turning, s, motors[:2], motors[2:], push,  # type: ignore[arg-type]
                        plant.sensor.step)
    places = {
        'following': (*later, *after), 'outputs': plant.measured(later),
        'commands': drive.commands, 'lag': drive.lag,
        'when': (*required(drive.ages), required(drive.fraction)),
    }
    at = {name: np.array([i for one in leaves(value) for i in listing.apart(one)], dtype=np.int64)
          for name, value in places.items()}
    code, split = listing.needed([int(i) for one in at.values() for i in one], split)
    number: dict[str, Any] = {
        'sent': int(sent.at[0]), 'push': int(push.at[0]),
        'motors': int(motors.at[0, 0]), 'state': first, 'split': split, **at,
    }
    return Program(
        code, np.array([*listing.more, 0], dtype=np.int64), np.array([*listing.tables, 0.0]),
        np.array(listing.start),
        kernels.Places(**number), np.ascontiguousarray(drive.row),
        np.ascontiguousarray(drive.factors), listing.called(code),
    )


class Running:
    """A plant in flight, in compiled code: `rate` and `angle` as they are measured now."""

    def __init__(self, made: Program, flying: Flying, x: State) -> None:
        plant = flying.plant
        self.made, self.dt, self._newest = made, plant.dt, 0
        known = leaves(tuple(getattr(flying.around, name) for name in OUTSIDE))
        self.moving = [i for i, row in enumerate(known) if row.size > 1]
        """Which of the known signals change from cycle to cycle."""
        self._known = [known[i] for i in self.moving]
        self.registers = made.start.copy()
        self.registers[: len(known)] = [row[0] for row in known]
        numbers = np.concatenate([one.ravel() for one in leaves((x.turning, x.hidden))])
        at = made.places
        self.registers[at.state : at.state + numbers.size] = numbers
        self.line = np.ascontiguousarray(x.line[..., 0])
        self.motors = np.ascontiguousarray(x.motors[:, 0])
        self._wide = (made.row[None], made.factors[None], self.registers[:, None],
                      self.line[..., None], self.motors[:, None])
        self.calls = made.calls
        self._before = self._operations(0, at.split)
        self._behind = self._operations(at.split, len(made.code))
        rate, angle = plant.measured(x)
        self.rate, self.angle = float(rate[0]), float(required(angle)[0])

    @property
    def kind(self) -> tuple[Any, ...]:
        """Key that is equal for flights that can be computed side by side."""
        return *self.made.kind, *self.moving

    def rows(self, n: int) -> FloatArray:
        """(s, n) values over n cycles of the signals in `moving`."""
        return np.array([np.broadcast_to(row, (n,)) for row in self._known]).reshape(-1, n)

    def step(self, u: float, push: float = 0.0) -> None:
        """Fly one cycle with a command, where what is around stays; push in rad/s²."""
        r, made = self.registers, self.made
        at = made.places
        r[at.sent], r[at.push] = u, push
        for do in self._before:
            do()
        self._newest = kernels.motors(at, *self._wide, self._newest, self.dt)
        for do in self._behind:
            do()
        r[at.state : at.state + at.following.size] = r[at.following]
        self.rate, self.angle = float(r[at.outputs[0]]), float(r[at.outputs[1]])

    def _operations(self, begin: int, end: int) -> list[Callable[[], Any]]:
        """The operations [begin, end): compiled code, and the laws in Python among it."""
        made, out = self.made, list[Callable[[], Any]]()
        inside = [(k, call) for k, call in made.calls if begin <= k < end]
        for k, call in (*inside, (end, None)):
            if begin < k:
                out.append(partial(
                    laws.carried, made.code[begin:k], made.more, made.tables[:, None],
                    self.registers[:, None], NOTHING, NOWHERE, NOWHERE, 0, 1, NOTHING))
            if call is not None:
                out.append(call.on(self.registers))
            begin = k + 1
        return out


def running(flying: Flying, rate: float = 0.0, angle: float = 0.0) -> Running:
    """The plant from a rate and an angle on, rad/s and rad, motors at rest."""
    known = tuple(getattr(flying.around, name) is not None for name in OUTSIDE)
    return Running(program(flying.plant, known), flying, flying.begin(rate, angle))


def _signal(values: npt.ArrayLike | None, n: int, name: str) -> FloatArray:
    array = np.asarray(0.0 if values is None else values, dtype=float)
    if not np.isfinite(array).all():
        raise BadInputError('simulate', f'{name} must be finite')
    return np.broadcast_to(array, (*array.shape[:-1], n))


def _checked_reference(reference: npt.ArrayLike, dt: float, own: Sequence[float],
                       most: int = 1) -> FloatArray:
    array = np.ascontiguousarray(np.asarray(reference, dtype=float))
    if not 1 <= array.ndim <= most or array.size == 0 or not np.isfinite(array).all():
        raise BadInputError('simulate', 'the reference must be (n,), finite, n > 0', array.shape)
    for plant_dt in own:
        if not math.isclose(dt, plant_dt, rel_tol=1e-6):
            raise BadInputError('simulate', f"dt must be the plant's {plant_dt} s", dt)
    return array


TOGETHER = 32
"""Flights whose cycles are computed side by side: the numbers of more leave the fast cache."""


def simulate_cascade(
    flying: Flying | AxisModel | Sequence[Flying], gains: CascadeGains | Sequence[CascadeGains],
    reference_angle: npt.ArrayLike, dt: float,
    noise: npt.ArrayLike | None = None, disturbance: npt.ArrayLike | None = None, *,
    rate_excitation: npt.ArrayLike | None = None, control_excitation: npt.ArrayLike | None = None,
    initial_angle: float = 0.0, initial_rate: float = 0.0, angle_lead_s: float = 0.0,
) -> LoopResponse:
    """Simulate the cascade around a plant, or a model's, for an angle reference (n,), rad.

    noise (n,) rad/s is on the measured rate; disturbance (n,) or a number, rad/s², acts on the
    axis and is held over the cycle. rate_excitation and control_excitation (n,) are added after
    the limits of C1 and C2, as in the firmware; the reference contains an excitation of the
    attitude. The drive starts at zero. angle_lead_s is the lead of the measured angle over the
    rate's integral (`angle_lead_s`). f flights at once, which is quicker: f plants, f sets of
    gains, signals (f, n), or several of these. Raises BadInputError for wrong shapes, values that
    are not finite, and a dt that is not the plant's.
    """
    if isinstance(flying, AxisModel):
        from quad_sysid.loop.from_model import loop_plant

        flying = loop_plant(flying)
    plants = list(flying) if isinstance(flying, Sequence) else [flying]
    sets = [gains] if isinstance(gains, CascadeGains) else list(gains)
    reference = _checked_reference(reference_angle, dt, [one.dt for one in plants], 2)
    n = reference.shape[-1]
    signals = (reference, _signal(noise, n, 'noise'), _signal(disturbance, n, 'disturbance'),
               _signal(rate_excitation, n, 'rate_excitation'),
               _signal(control_excitation, n, 'control_excitation'))
    rows = np.broadcast_arrays(*(np.zeros((len(x), 1)) for x in (plants, sets)), *signals)[2:]
    flights, lead = len(rows[0]), float(angle_lead_s)
    sets *= flights // len(sets)
    starts = [running(one, initial_rate, initial_angle) for one in plants]
    while len(starts) < flights:  # laws in Python fly the start itself
        starts.append(running(plants[0], initial_rate, initial_angle) if starts[0].calls
                      else starts[0])
    groups: dict[Any, list[int]] = {}
    for i, now in enumerate(starts):
        groups.setdefault(now.kind, []).append(i)
    out = np.empty((flights, 4, n))
    for each in groups.values():
        for first in range(0, len(each), TOGETHER):
            some = each[first : first + TOGETHER]
            inputs = np.stack([row[some] for row in rows], axis=1)
            if starts[some[0]].calls:
                for i, own in zip(some, inputs, strict=True):
                    out[i] = _in_python(starts[i], sets[i], own, lead)
            else:
                out[some] = _side_by_side([starts[i] for i in some], [sets[i] for i in some],
                                          inputs, lead)
    alone = all(signal.ndim == 1 for signal in signals) \
        and not any(isinstance(x, Sequence) for x in (flying, gains))
    return LoopResponse(*(out[0] if alone else out.transpose(1, 0, 2)))


def _side_by_side(starts: Sequence[Running], sets: Sequence[CascadeGains], signals: FloatArray,
                  lead: float) -> FloatArray:
    """(f, 4, n) flights of one kind, as kernels.fly says."""
    made, n = starts[0].made, signals.shape[2]
    longest = max(len(now.line) for now in starts)  # each holds the first command all over
    out = np.empty((len(starts), 4, n))
    kernels.fly(
        constants_of(sets, starts[0].dt),
        made.places, made.code, made.more, np.stack([now.made.tables for now in starts], axis=1),
        np.stack([now.made.row for now in starts]), np.stack([now.made.factors for now in starts]),
        np.stack([now.registers for now in starts], axis=1),
        np.array([(now.rate, now.angle) for now in starts]),
        np.stack([np.resize(now.line, (longest, now.motors.size)) for now in starts], axis=2),
        np.stack([now.motors for now in starts], axis=1), np.array(starts[0].moving, np.int64),
        np.stack([now.rows(n) for now in starts]), signals, out, lead)
    return out


def _in_python(now: Running, gains: CascadeGains, signals: FloatArray, lead: float) -> FloatArray:
    """(4, n) a flight cycle by cycle, where laws are called."""
    numbers, (_, n) = gains.constants(now.dt), signals.shape
    memory, out, rows = np.zeros((1, kernels.MEMORY)), np.zeros((4, n)), now.rows(n)
    measured, inputs, u = np.zeros((2, 1)), np.zeros((1, 3)), np.zeros(1)
    if not gains.d_on_error:
        memory[:, kernels.LAST] = now.rate
        memory[:, kernels.NOTCH :] = (1.0 - numbers.notch) * now.rate
    for k, (reference, noise, push, at_rate, at_control) in enumerate(signals.T.tolist()):
        rate = now.rate + noise
        angle = now.angle + lead * rate
        inputs[0], measured[:, 0] = (reference, at_rate, at_control), (angle, rate)
        kernels.control_each(numbers, memory, inputs, measured[0], measured[1], u)
        aim = min(max(gains.angle_kp * (reference - angle), -gains.rate_limit), gains.rate_limit)
        out[:, k] = angle, rate, u[0], aim + at_rate
        now.registers[now.moving] = rows[:, k]
        now.step(float(u[0]), push)
    return out


def simulate_polynomial_cascade(
    A: npt.ArrayLike, B: npt.ArrayLike, gains: CascadeGains, reference: npt.ArrayLike, dt: float,
    *, angle_lead_s: float = 0.0,
) -> LoopResponse:
    """Simulate the cascade around A(q) rate = B(q) u (the paper's step B).

    A (na + 1,) with A[0] != 0; B (m,) in powers of q^-1 from q^0, its leading zeros are the
    delay. The angle is the trapezoidal sum of the rate, ahead by angle_lead_s. A model without
    delay would need u before it is known: BadInputError.
    """
    array = _checked_reference(reference, dt, [dt])
    a = np.asarray(A, dtype=float)
    b = np.asarray(B, dtype=float)
    if a.ndim != 1 or a.size == 0 or a[0] == 0 or not np.isfinite(a).all():
        raise BadInputError('simulate', 'A must be 1-D, finite, with A[0] not 0')
    if not np.isfinite(b).all() or (b.size and b[0] != 0):
        raise BadInputError('simulate', 'B must be finite and act after one cycle at least',
                            remedy='use nk >= 1')
    out = np.zeros((4, array.size))
    kernels.run_polynomial(gains.constants(dt), array, a / a[0], b / a[0], out,
                           float(angle_lead_s))
    return LoopResponse(*out)


LEAST_EXPLAINED = 0.9
"""Least share of the angle's steps that a lead must explain."""


def angle_lead_s(angle: FloatArray | None, rate: FloatArray, dt: float) -> float:
    """Lead in s, -dt/2..dt/2, of angle (n,) rad over the integral of rate (n,) rad/s.

    Least squares of w in a(k) - a(k-1) = dt (w rate(k) + (1 - w) rate(k-1)); the lead is
    (w - 1/2) dt: 0 for trapezoids, dt/2 for rectangles with the newest rate. It is 0 where the
    angle is unknown or not the integral of this rate.
    """
    if angle is None:
        return 0.0
    step = np.diff(angle) - dt * rate[:-1]
    turn = dt * np.diff(rate)
    known = np.isfinite(step) & np.isfinite(turn)
    step, turn = step[known], turn[known]
    power = float(turn @ turn)
    if not power > 0.0:
        return 0.0
    share = float(turn @ step) / power
    residual = step - share * turn
    if float(residual @ residual) > (1.0 - LEAST_EXPLAINED) * float(step @ step):
        return 0.0
    return (min(max(share, 0.0), 1.0) - 0.5) * dt
