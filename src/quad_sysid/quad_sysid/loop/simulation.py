"""The closed loop over time: the cascade around a Plant or a polynomial model.

The plant's own laws, noted once as operations on numbers (model/traced.py), run in compiled code;
one that cannot be noted is called among them. The controller is that of kernels.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop import kernels
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.plant import Flying
from quad_sysid.model import AxisModel
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


def _rows(value: Any) -> list[Any]:
    """A signal's arrays: none, one, or one of either other axis."""
    return [] if value is None else [*value] if isinstance(value, tuple) else [value]


@dataclass(frozen=True)
class Program:
    """A plant's laws as compiled code takes them."""

    code: npt.NDArray[np.int64]
    more: npt.NDArray[np.int64]
    tables: FloatArray
    start: FloatArray
    places: kernels.Places
    calls: Sequence[tuple[int, Call]]
    """Which operations are laws in Python."""


LAWS = ('torque', 'command', 'actuate', 'advance')
CHANNELS = ('commands', 'lag', 'ages', 'fraction')
"""What a law may change of a Drive from cycle to cycle."""


class _Noted:
    """An effect whose laws are noted, or called where they cannot be: on a value's branch, say."""

    def __init__(self, effect: Effect, listing: Listing) -> None:
        self.effect, self.listing = effect, listing

    def __getattr__(self, name: str) -> Any:
        own = getattr(self.effect, name)
        return partial(self._noted, own) if name in LAWS else own

    def _noted(self, law: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return law(*arguments)
        except (Untraceable, TypeError, IndexError, ValueError):
            pass
        *first, s, p, settings = arguments
        tree = {'s': vars(s), 'first': tuple(
            vars(one) if isinstance(one, Drive) else one for one in first)}

        def ready(seen: Any) -> Callable[[], Any]:
            own = [Drive(**x) if isinstance(x, dict) else x for x in seen['first']]
            signals = Signals(**seen['s'])
            return lambda: law(*own, signals, p, settings)

        def made(seen: Any) -> Callable[[], Sequence[FloatArray]]:
            call = ready(seen)
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
    """The operations of a cycle of a plant, `known`: which of OUTSIDE are."""
    given = Signals.at_rest(np.zeros(1), np.zeros(1))
    one = replace(given, battery_v=np.zeros(1), sent=np.zeros(1))
    rest = plant.begin(plant.with_motors(one), np.zeros(1), np.zeros(1))
    listing = Listing()

    def with_notes(part: Part) -> Part:
        return replace(part, effect=cast('Effect', _Noted(part.effect, listing)))

    own = plant.structure
    noted = replace(plant, structure=replace(
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
    s = plant.with_own(replace(given, **fields, sent=sent))  # type: ignore[arg-type]
    s = plant.with_motors(s)
    drive, after = noted.send(hidden, s)
    split = len(listing.code)
    later = noted.turn(turning, s, motors[:2], motors[2:], push,  # type: ignore[arg-type]
                       plant.sensor.step)
    places = {
        'following': (*later, *after), 'shown': plant.measured(later),
        'commands': drive.commands, 'lag': drive.lag,
        'when': (*required(drive.ages), required(drive.fraction)),
    }
    nowhere = np.zeros(0, np.int64)
    at = {name: np.concatenate([nowhere, *(listing.places(one).ravel() for one in leaves(value))])
          for name, value in places.items()}
    code, split = listing.needed([int(i) for one in at.values() for i in one], split)
    number: dict[str, Any] = {
        'given': 0, 'sent': int(sent.at[0]), 'push': int(push.at[0]),
        'motors': int(motors.at[0, 0]), 'state': first, 'split': split, **at,
    }
    return Program(
        code, np.array([*listing.more, 0], dtype=np.int64), np.array([*listing.tables, 0.0]),
        np.array(listing.start),
        kernels.Places(**number, row=np.ascontiguousarray(drive.row),
                       factors=np.ascontiguousarray(drive.factors)),
        listing.called(code),
    )


class Running:
    """A plant in flight, in compiled code: `rate` and `angle` as they are measured now."""

    def __init__(self, made: Program, flying: Flying, x: State) -> None:
        plant = flying.plant
        self.made, self.dt, self._newest = made, plant.dt, 0
        self.known = [getattr(flying.around, name) for name in OUTSIDE]
        self.registers = made.start.copy()
        numbers = np.concatenate([one.ravel() for one in leaves((x.turning, x.hidden))])
        at = made.places
        self.registers[at.state : at.state + numbers.size] = numbers
        self.line = np.ascontiguousarray(x.line[..., 0])
        self.motors = np.ascontiguousarray(x.motors[:, 0])
        self.calls = [(k, call.on(self.registers)) for k, call in made.calls]
        rate, angle = plant.measured(x)
        self.rate, self.angle = float(rate[0]), float(required(angle)[0])

    def rows(self, n: int) -> FloatArray:
        """(n, s) what is known of each cycle."""
        rows = [np.broadcast_to(row, (n,)) for value in self.known for row in _rows(value)]
        return np.ascontiguousarray(np.stack(rows, axis=1))

    def step(self, u: float, push: float = 0.0) -> None:
        """Fly one cycle with a command, where what is around stays; push in rad/s²."""
        r, made = self.registers, self.made
        at = made.places
        r[at.sent], r[at.push] = u, push
        if self.calls:
            self._operate(0, at.split)
            self._newest = kernels.motors(at, r, self.line, self.motors, self._newest, self.dt)
            self._operate(at.split, len(made.code))
            r[at.state : at.state + at.following.size] = r[at.following]
        else:
            self._newest = kernels.cycle(at, made.code, made.more, made.tables, r, self.line,
                                         self.motors, self._newest, self.dt)
        self.rate, self.angle = float(r[at.shown[0]]), float(r[at.shown[1]])

    def _operate(self, begin: int, end: int) -> None:
        """Do the operations [begin, end), with the laws in Python among them."""
        made = self.made
        for k, call in self.calls:
            if begin <= k < end:
                kernels.part(made.code, made.more, made.tables, self.registers, begin, k)
                call()
                begin = k + 1
        kernels.part(made.code, made.more, made.tables, self.registers, begin, end)


def running(flying: Flying, rate: float = 0.0, angle: float = 0.0) -> Running:
    """The plant from a rate and an angle on, rad/s and rad, motors at rest."""
    known = tuple(getattr(flying.around, name) is not None for name in OUTSIDE)
    out = Running(program(flying.plant, known), flying, flying.begin(rate, angle))
    given = out.rows(flying.around.time.size)[0]
    out.registers[: given.size] = given
    return out


def _signal(values: npt.ArrayLike | None, n: int, name: str) -> FloatArray:
    if values is None:
        return np.zeros(n)
    array = np.ascontiguousarray(np.broadcast_to(np.asarray(values, dtype=float), (n,)))
    if not np.isfinite(array).all():
        raise BadInputError('simulate', f'{name} must be finite')
    return array


def _checked_reference(reference: npt.ArrayLike, dt: float, plant_dt: float) -> FloatArray:
    array = np.ascontiguousarray(np.asarray(reference, dtype=float))
    if array.ndim != 1 or array.size == 0 or not np.isfinite(array).all():
        raise BadInputError('simulate', 'the reference must be (n,), finite, n > 0', array.shape)
    if not math.isclose(dt, plant_dt, rel_tol=1e-6):
        raise BadInputError('simulate', f"dt must be the plant's {plant_dt} s", dt)
    return array


def simulate_cascade(
    flying: Flying | AxisModel, gains: CascadeGains, reference_angle: npt.ArrayLike, dt: float,
    noise: npt.ArrayLike | None = None, disturbance: npt.ArrayLike | None = None, *,
    rate_excitation: npt.ArrayLike | None = None, control_excitation: npt.ArrayLike | None = None,
    initial_angle: float = 0.0, initial_rate: float = 0.0, angle_lead_s: float = 0.0,
) -> LoopResponse:
    """Simulate the cascade around a plant, or a model's, for an angle reference (n,), rad.

    noise (n,) rad/s is on the measured rate; disturbance (n,) or a number, rad/s², acts on the
    axis and is held over the cycle. rate_excitation and control_excitation (n,) are added after
    the limits of C1 and C2, as in the firmware; the reference contains an excitation of the
    attitude. The drive starts at zero. angle_lead_s is the lead of the measured angle over the
    rate's integral (`angle_lead_s`). Raises BadInputError for wrong shapes, values that are not
    finite, and a dt that is not the plant's.
    """
    if isinstance(flying, AxisModel):
        from quad_sysid.loop.from_model import loop_plant

        flying = loop_plant(flying)
    reference = _checked_reference(reference_angle, dt, flying.dt)
    n, plant = reference.size, flying.plant
    signals = np.stack((reference, _signal(noise, n, 'noise'),
                        _signal(disturbance, n, 'disturbance'),
                        _signal(rate_excitation, n, 'rate_excitation'),
                        _signal(control_excitation, n, 'control_excitation')))
    now = running(flying, initial_rate, initial_angle)
    if now.calls:
        return _in_python(now, gains, signals, float(angle_lead_s))
    made, out = now.made, np.zeros((4, n))
    kernels.fly(gains.constants(plant.dt), made.places, made.code, made.more, made.tables,
                now.registers, np.array([now.rate, now.angle]), now.line, now.motors, now.rows(n),
                signals, out, float(angle_lead_s))
    return LoopResponse(*out)


def _in_python(now: Running, gains: CascadeGains, signals: FloatArray,
               lead: float) -> LoopResponse:
    """The same cycle by cycle, where laws are called."""
    numbers, (_, n) = gains.constants(now.dt), signals.shape
    memory, out, rows = np.zeros((1, kernels.MEMORY)), np.zeros((4, n)), now.rows(n)
    seen, inputs, u = np.zeros((2, 1)), np.zeros((1, 3)), np.zeros(1)
    if not gains.d_on_error:
        memory[:, kernels.LAST] = now.rate
        memory[:, kernels.NOTCH :] = (1.0 - numbers.notch) * now.rate
    for k, (wanted, noise, push, at_rate, at_control) in enumerate(signals.T.tolist()):
        rate = now.rate + noise
        angle = now.angle + lead * rate
        inputs[0], seen[:, 0] = (wanted, at_rate, at_control), (angle, rate)
        kernels.control_each(numbers, memory, inputs, seen[0], seen[1], u)
        aim = min(max(gains.angle_kp * (wanted - angle), -gains.rate_limit), gains.rate_limit)
        out[:, k] = angle, rate, u[0], aim + at_rate
        now.registers[: rows.shape[1]] = rows[k]
        now.step(float(u[0]), push)
    return LoopResponse(*out)


def simulate_polynomial_cascade(
    A: npt.ArrayLike, B: npt.ArrayLike, gains: CascadeGains, reference: npt.ArrayLike, dt: float,
    *, noise: npt.ArrayLike | None = None, angle_lead_s: float = 0.0,
) -> LoopResponse:
    """Simulate the cascade around A(q) rate = B(q) u (the paper's step B).

    A (na + 1,) with A[0] != 0; B (m,) in powers of q^-1 from q^0, its leading zeros are the
    delay. The angle is the trapezoidal sum of the rate, ahead by angle_lead_s. A model without
    delay would need u before it is known: BadInputError.
    """
    array = _checked_reference(reference, dt, dt)
    a = np.asarray(A, dtype=float)
    b = np.asarray(B, dtype=float)
    if a.ndim != 1 or a.size == 0 or a[0] == 0 or not np.isfinite(a).all():
        raise BadInputError('simulate', 'A must be 1-D, finite, with A[0] not 0')
    if not np.isfinite(b).all() or (b.size and b[0] != 0):
        raise BadInputError('simulate', 'B must be finite and act after one cycle at least',
                            remedy='use nk >= 1')
    out = np.zeros((4, array.size))
    signals = np.stack((array, _signal(noise, array.size, 'noise')))
    kernels.run_polynomial(gains.constants(dt), signals, a / a[0], b / a[0], out,
                           float(angle_lead_s))
    return LoopResponse(*out)


BELIEVED = 0.9
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
    left = step - share * turn
    if float(left @ left) > (1.0 - BELIEVED) * float(step @ step):
        return 0.0
    return (min(max(share, 0.0), 1.0) - 0.5) * dt
