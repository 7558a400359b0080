"""A bag or log → what it holds and suffices for: topics, excitation, coherence, limits, battery.

Nothing is fitted; the conditions are those of the pipeline. cli.py prints it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from quad_sysid.bags import read_bag, split_segments
from quad_sysid.bags.storage import Storage
from quad_sysid.blackbox import excitation_order
from quad_sysid.contract import AXES, IDLE, TOPIC_TYPES
from quad_sysid.craft import Craft, X
from quad_sysid.discover.constants import DIFFERS
from quad_sysid.effects import EFFECTS
from quad_sysid.effects.constants import SAG_SHOWS
from quad_sysid.errors import BadInputError, NotInformativeError, QuadSysidError
from quad_sysid.foresight import improvement
from quad_sysid.imports.formats import check_single, format_of
from quad_sysid.imports.guess import read_any
from quad_sysid.imports.table import head_of, is_bag
from quad_sysid.imports.to_bag import record_of, uneven
from quad_sysid.model.data import AxisData, Span, axis_data
from quad_sysid.model.effect import required
from quad_sysid.motor_layout import (
    Pattern,
    commands_of,
    confirmed,
    doubts,
    opposite,
    patterns_of,
    places,
)
from quad_sysid.pipeline.advice import RICHEST
from quad_sysid.pipeline.answer import Use
from quad_sysid.pipeline.assemble import Support
from quad_sysid.pipeline.blackbox_part import io_data
from quad_sysid.pipeline.evaluate import flown_spans
from quad_sysid.pipeline.identify import excited_axes
from quad_sysid.pipeline.usable import check_usable, refusal, too_few_windows
from quad_sysid.record import Record, Segment, finite_runs, motors_at_limit
from quad_sysid.rotors import rotors_of

GAP_CYCLES = 1.5
"""A pause between stamps longer than this many intervals is a gap."""
ON_CHANGE = 'rcl_interfaces/msg/ParameterEvent'
UNTIMED = 'std_msgs/msg/String', 'diagnostic_msgs/msg/DiagnosticArray'
"""Types without a stamp, or of several nodes, each with its own clock."""
STAMP_END = 12
"""Bytes of a message up to the end of its stamp: encapsulation, seconds, nanoseconds."""


@dataclass(frozen=True)
class TopicContent:
    """One topic of the bag."""

    name: str
    messages: int
    rate_hz: float | None
    """Median rate of the stamps; None for a topic on change, or with fewer than 3 stamps."""
    span_s: float
    """Time from the first stamp to the last, s."""
    gaps: int
    longest_gap_s: float
    """Time between the stamps around the longest gap, s."""

    @property
    def longest_lost_s(self) -> float:
        """Time without samples of the longest gap: one cycle less, as the record counts it."""
        return self.longest_gap_s - (1.0 / self.rate_hz if self.rate_hz else 0.0)


@dataclass(frozen=True)
class Topics:
    """All topics with messages, in the order of the contract, and warnings of the reader."""

    present: tuple[TopicContent, ...]
    absent: tuple[str, ...]
    warnings: tuple[str, ...]


def topics(path: Path) -> Topics:
    """Count every topic of the contract in a bag; raises BadInputError where it is none."""
    storage = Storage(path, tuple(TOPIC_TYPES))
    stamps: dict[str, list[npt.NDArray[np.int64]]] = {}
    for batch in storage.batches():
        for topic, raws in batch.items():
            untimed = TOPIC_TYPES[topic] in UNTIMED
            stamps.setdefault(topic, []).append(
                np.zeros(len(raws), np.int64) if untimed else _stamps(raws))
    present = tuple(
        _content(topic, np.concatenate(stamps[topic])) for topic in TOPIC_TYPES if topic in stamps
    )
    absent = tuple(topic for topic in TOPIC_TYPES if topic not in stamps)
    return Topics(present, absent, tuple(storage.warnings))


def _stamps(raws: Iterable[bytes]) -> npt.NDArray[np.int64]:
    """(n,) ns, from the first two words behind each message's 4 bytes of encapsulation."""
    complete = [raw for raw in raws if len(raw) >= STAMP_END]
    words = b''.join(bytes(raw[4:STAMP_END]) for raw in complete)
    little = np.array([raw[1] & 1 for raw in complete], dtype=bool)
    as_little = np.frombuffer(words, '<u4').reshape(-1, 2).astype(np.int64)
    as_big = np.frombuffer(words, '>u4').reshape(-1, 2).astype(np.int64)
    parts = np.where(little[:, None], as_little, as_big)
    stamps: npt.NDArray[np.int64] = parts[:, 0] * 1_000_000_000 + parts[:, 1]
    return stamps


def _content(topic: str, stamps: npt.NDArray[np.int64]) -> TopicContent:
    times = np.unique(stamps[stamps > 0])
    steps = np.diff(times) * 1e-9
    span = float(steps.sum()) if steps.size else 0.0
    if TOPIC_TYPES[topic] == ON_CHANGE or times.size < 3:
        return TopicContent(topic, int(stamps.size), None, span, 0, 0.0)
    usual = float(np.median(steps))
    wide = steps > GAP_CYCLES * usual
    return TopicContent(topic, int(stamps.size), 1.0 / usual, span, int(np.count_nonzero(wide)),
                        float(steps.max()) if wide.any() else 0.0)


MOVES = 1e-9
"""Spread below which a signal counts as constant."""


def uses_of_axis(record: Record, data: AxisData, reason: str) -> tuple[Use, ...]:
    """The uses that one axis' data allow: identification first, then those that need more signals.

    `reason`: why the commands do not predict the rate; empty where they do.
    """
    axis, refused = data.axis, reason
    try:
        check_usable(data, (record,))
    except NotInformativeError as error:
        refused = str(error).removeprefix(f'{axis}: ')
    refused = refused or too_few_windows(data)
    identify = Use(f'identify {axis}', possible=not refused, because=refused)
    if refused:
        return (identify,)
    reference = _moves(data, data.reference)
    gains = f'{axis}.rate.kp' in record.gains_at(np.inf)
    other = '/setpoint/attitude or /excitation/applied is missing or never moves'
    no_gains = '/gains/active is missing'
    return (
        identify,
        Use('indirect and joint approach', reference, '' if reference else other),
        Use('closed-loop check', reference and gains,
            '' if reference and gains else other if not reference else no_gains),
        Use('gain design', gains, '' if gains else no_gains),
        *(_effect(words, name, data) for words, name in _EFFECTS),
    )


def _unpredictive(data: AxisData) -> str:
    """Why the commands do not predict the rate; empty where they do."""
    ratio = improvement(data.rate, data.control, data.train, data.dt)
    if ratio >= DIFFERS:
        return ''
    return ('the commands do not predict the rate better than past rates do (its error falls by a '
            f'factor of {ratio:.2f}, {DIFFERS:g} is needed); is the axis held? Excite it, with '
            'more amplitude where it was excited')


def _uses_of_flight(axes: Sequence[AxisContent], rate_hz: float) -> tuple[Use, ...]:
    """What the flight as a whole allows."""
    moving = any(axis.evaluable for axis in axes)
    return (Use('evaluate a stored model', moving,
                f"one of this bag's rate, {rate_hz:.4g} Hz" if moving else
                'no axis holds rate and command that move for half a second'),)


def _moves(data: AxisData, signal: np.ndarray | None) -> bool:
    if signal is None:
        return False
    used = np.concatenate([signal[a:b] for a, b in data.train])
    return bool(np.isfinite(used).all() and np.ptp(used) > MOVES)


def _effect(words: str, name: str, data: AxisData) -> Use:
    """Whether any effect of this name can be tested on the data."""
    answers = [effect.prepare(data) for effect in EFFECTS if effect.name == name]
    refused = [answer for answer in answers if isinstance(answer, str)]
    because = refused[0] if len(refused) == len(answers) else ''
    return Use(f'find {words}', possible=not because,
               because=because or (_weak_sag(data) if name == 'battery_sag' else ''))


def _weak_sag(data: AxisData) -> str:
    """A condition where the voltage moves less than shows how the thrust follows it."""
    volts = data.training(required(data.battery_v))
    sag = float(np.ptp(volts) / np.mean(volts))
    return '' if sag >= SAG_SHOWS else (
        f'a strong one only: the voltage moves by {100.0 * sag:.2g} %, and '
        f'{100.0 * SAG_SHOWS:g} % always show it')


_EFFECTS = (
    ('effects of the measured angle', 'cubic_stiffness'),
    ('battery sag', 'battery_sag'),
    ('thrust curve', 'thrust_curve'),
    ("another axis' command", 'cross_axis_input'),
)
"""Effects that need more than the axis' own motion."""


@dataclass(frozen=True)
class AxisContent:
    """One axis over its training segments; figures are None where it has none."""

    axis: str
    train_s: float
    validation_s: float
    windows: int
    """Free-run windows of 0.5 s in the validation segments."""
    evaluable: bool
    """Whether a stored model can run beside it, in any segment but the idle ones."""
    uses: tuple[Use, ...]
    rate_rms: float | None = None
    """rad/s about the mean."""
    command_rms: float | None = None
    """Normalised, about the mean."""
    reference_rms: float | None = None
    """rad, rad/s or normalised, as the excitation is injected; None where the bag lacks it."""
    excitation_order: int | None = None
    """Order to which the command is persistently exciting, at most RICHEST; 0: it stands still."""
    coherent_band_rad_s: tuple[float, float] | None = None
    """Widest unbroken band of squared coherence above 0.6; None where the commands do not predict
    the rate: feedback makes noise coherent with itself."""


@dataclass(frozen=True)
class Battery:
    """Pack voltage over the flight, V."""

    first: float
    last: float
    lowest: float


@dataclass(frozen=True)
class MotorPlace:
    """One motor of the craft, m in the body frame FLU, and the signs with which it turns axes."""

    name: str
    place: str
    x: float
    y: float
    spin: int
    """1 where the propeller turns counter-clockwise seen from above, -1 where clockwise."""
    expected: tuple[int, ...]
    """Sign of its effect on roll, pitch and yaw by place and spin; 0: none."""
    shown: tuple[int | None, ...]
    """Sign of its effect by the motion; None where the flight does not show it for certain."""


@dataclass(frozen=True)
class Content:
    """Content and uses of a bag."""

    source: str
    topics: Topics
    sample_rate_hz: float | None = None
    length_s: float = 0.0
    lost_pct: float = 0.0
    """Share of the control cycles without /imu/data, %."""
    longest_gap_s: float = 0.0
    """Cycles lost one after the other; between the stamps around them lies one cycle more."""
    split: bool = False
    """Whether the bag has no segments and was split in time."""
    segments: tuple[Segment, ...] = ()
    gains: tuple[str, ...] = ()
    """Names in /gains/active, in alphabetical order."""
    motors_at_limit_pct: tuple[float, ...] = ()
    """Per motor, share of the time at a limit, 1 or `mixer.idle`, idle segments left out where
    others are; empty where /motors/command is missing."""
    battery: Battery | None = None
    craft: str = ''
    """Places of the motors, in words; empty where only the control is known."""
    rotors: tuple[str, ...] = ()
    """The motors' lag by the measured speeds of the rotors, and motors that lag, slip or stop."""
    layout: tuple[Pattern, ...] = ()
    """Patterns of each moving axis by the motion, in the order of the contract: of the motors, or
    where the bag lacks them of the axis' command."""
    motors: tuple[MotorPlace, ...] = ()
    """Each motor of the craft, with the signs that the motion shows."""
    axes: tuple[AxisContent, ...] = ()
    uses: tuple[Use, ...] = ()
    """Uses of the whole flight."""
    unusable: str = ''
    """Why it cannot be read as a record; then there are only the topics."""
    warnings: tuple[str, ...] = ()


def content(path: str | Path, log: int = 1, messages: Path | None = None) -> Content:
    """Content of a bag, a log or a table; raises BadInputError where it cannot be read.

    `log`: of several in a blackbox file; `messages`: a folder of .msg files.
    """
    source, listing = str(path), Topics((), (), ())
    record: Record | None = None
    if is_bag(Path(path), head_of(Path(path))):
        listing = topics(Path(path))
        try:
            record = read_bag(path)
        except BadInputError as error:
            if format_of(Path(path)) is None:  # else of another autopilot
                return Content(source, listing, unusable=str(error), warnings=listing.warnings)
    if record is not None:
        check_single(Path(path), 'a bag', log)
    else:
        read = read_any(Path(path), log, messages)
        laid = record_of(read)
        record = replace(laid.record, warnings=(
            *read.checks, *laid.warnings, *uneven(laid.notes), *laid.record.warnings))
    named = any(s.role in ('train', 'validation') for s in record.segments)
    with threadpool_limits(limits=1):
        return of_record(split_segments(record), listing, split=not named)


def of_record(record: Record, listing: Topics, *, split: bool) -> Content:
    """Content of a record with its segments."""
    lost = np.asarray(np.isnan(record.rates).any(axis=1))
    gaps = finite_runs(lost, (0, record.n))
    warning = refusal(record)
    axes = tuple(_axis(record, axis) for axis in excited_axes([record]))
    layout, contradictions = _layout(record)
    return Content(record.source, listing, sample_rate_hz=1.0 / record.dt,
                   length_s=record.n * record.dt, lost_pct=100.0 * float(np.mean(lost)),
                   longest_gap_s=max((b - a for a, b in gaps), default=0) * record.dt, split=split,
                   segments=record.segments, gains=tuple(sorted(record.gains_at(np.inf))),
                   motors_at_limit_pct=_at_limit(record), battery=_battery(record), layout=layout,
                   motors=_motors(record, layout), axes=axes,
                   uses=_uses_of_flight(axes, 1.0 / record.dt),
                   craft=described(record.craft)
                   if record.motors is not None or record.craft != X else '',
                   rotors=rotors_of(record).lines,
                   warnings=tuple(dict.fromkeys(
                       [*record.warnings, *((warning,) if warning else ()), *contradictions])))


def described(craft: Craft) -> str:
    """The craft's motors in one line."""
    turns = {1: 'counter-clockwise', -1: 'clockwise'}
    return f'{craft.name}: ' + ', '.join(
        f'motor_{k} {place} {turns[motor.spin]}'
        for k, (place, motor) in enumerate(zip(craft.places, craft.motors, strict=True), 1))


def _layout(record: Record) -> tuple[tuple[Pattern, ...], list[str]]:
    """What the motors, or without them the commands, do to the axes, and doubts about it."""
    if record.motors is None:
        patterns = commands_of(record.rates, record.control[:, 1:], record.dt, record.angles)
        return patterns, opposite(patterns, {})
    layout = confirmed(patterns_of(record.rates, record.motors, record.dt, record.angles),
                       record.rates, record.motors, record.dt)
    craft, suffix = record.craft, ' turns the wrong way'
    faults = places(layout, craft)[1]
    reversed_ = [fault.removesuffix(suffix) for fault in faults if fault.endswith(suffix)]
    if len(reversed_) > 1:
        faults = [fault for fault in faults if not fault.endswith(suffix)]
        faults.append(f'{", ".join(reversed_)} turn the wrong way')
    return layout, doubts(craft.name, craft.inverse, layout, record.rates, record.motors,
                          record.dt, record.angles) + faults


def _motors(record: Record, layout: Sequence[Pattern]) -> tuple[MotorPlace, ...]:
    """The craft's motors beside the patterns that are certain."""
    if record.motors is None:
        return ()
    craft = record.craft
    certain = {p.axis: p.signs for p in layout if p.certain and len(p.signs) == craft.count}
    return tuple(
        MotorPlace(f'motor_{k + 1}', place, motor.x, motor.y, motor.spin, expected, tuple(
            certain[axis][k] if axis in certain else None for axis in AXES))
        for k, (place, motor, expected) in enumerate(
            zip(craft.places, craft.motors, craft.signs, strict=True)))


def _axis(record: Record, axis: str) -> AxisContent:
    lengths = {
        role: sum(s.end_s - s.start_s for s in record.segments
                  if s.role == role and s.excites(axis))
        for role in ('train', 'validation')
    }
    try:
        record = record.for_axis(axis)
        data = axis_data([record], axis)
    except NotInformativeError as error:
        refused = Use(f'identify {axis}', possible=False,
                      because=str(error).removeprefix(f'{axis}: '))
        return AxisContent(axis, lengths['train'], lengths['validation'], 0,
                           evaluable=False, uses=(refused,))
    reason = _unpredictive(data)
    content = AxisContent(axis, lengths['train'], lengths['validation'],
                          data.windows(data.validation).count, _evaluable(record, data),
                          uses_of_axis(record, data, reason))
    if not data.train:
        return content
    command = _rms(data.command, data.train)
    reference = None if data.reference is None else _rms(data.reference, data.train)
    return replace(content, rate_rms=_rms(data.rate, data.train), command_rms=command,
                   reference_rms=reference,
                   excitation_order=_order(data, command),
                   coherent_band_rad_s=None if reason
                   else Support.of(io_data(data, data.train), data.axis).band)


def _order(data: AxisData, command_rms: float | None) -> int | None:
    if command_rms is not None and command_rms <= MOVES:
        return 0  # else rounding of the mixer would count as excitation
    try:
        return excitation_order(io_data(data, data.train), RICHEST)
    except QuadSysidError:
        return None


def _evaluable(record: Record, data: AxisData) -> bool:
    spans = flown_spans(record, data)
    return bool(data.windows(spans).count) and all(
        (_rms(signal, spans) or 0.0) > MOVES for signal in (data.rate, data.command))


def _rms(signal: np.ndarray, spans: Sequence[Span]) -> float | None:
    """Standard deviation over spans; None where it is not known there."""
    used = np.concatenate([signal[a:b] for a, b in spans])
    return float(np.std(used)) if np.isfinite(used).all() else None


def _at_limit(record: Record) -> tuple[float, ...]:
    if record.motors is None:
        return ()
    flown = np.ones(record.n, bool)
    for segment in record.segments:
        if segment.role == 'idle':  # on the ground they stand at 0
            flown[slice(*record.span(segment))] = False
    finite = np.isfinite(record.motors).all(axis=1)
    idle = record.gains_at(np.inf).get(IDLE, 0.0)
    used = record.motors[finite & flown] if (finite & flown).any() else record.motors[finite]
    return tuple(float(100.0 * share) for share in motors_at_limit(used, idle).mean(axis=0))


def _battery(record: Record) -> Battery | None:
    if record.battery_v is None:
        return None
    volts = record.battery_v[np.isfinite(record.battery_v)]
    if not volts.size:
        return None
    return Battery(float(volts[0]), float(volts[-1]), float(volts.min()))
