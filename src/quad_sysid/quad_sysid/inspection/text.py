"""A Content as a page of text for 80 columns."""

from __future__ import annotations

from collections.abc import Iterator

from quad_sysid.axes import EVERY
from quad_sysid.contract import AXES
from quad_sysid.inspection.content import AxisContent, Content, Use
from quad_sysid.report.tables import Table, wrapped

MAX_SEGMENTS = 12  # a screen; --json has all


def lines(content: Content) -> list[str]:
    """One page."""
    out = [content.source, *_topics(content)]
    if content.unusable:
        return [*out, '', *wrapped(f'not usable: {content.unusable}', '')]
    out += ['', *_flight(content), '', *_segments(content), '']
    for axis in content.axes:
        out += [*_axis(axis), '']
    out += ['usable for', *(line for use in content.uses for line in _use(use))]
    if content.warnings:
        shown = content.warnings[:8]
        more = len(content.warnings) - len(shown)
        out += ['', 'warnings', *(line for text in shown for line in wrapped(text, '  '))]
        out += [f'  and {more} more (--json)'] if more else []
    return out


def _topics(content: Content) -> Iterator[str]:
    rows = [
        [topic.name, str(topic.messages), '-' if topic.rate_hz is None else f'{topic.rate_hz:.4g}',
         f'{topic.span_s:.1f}', str(topic.gaps),
         f'{topic.longest_lost_s:.3f}' if topic.gaps else '-']
        for topic in content.topics.present
    ]
    if not rows:  # a log, not a bag
        return
    yield from Table(['topic', 'messages', 'rate, Hz', 'seconds', 'gaps', 'longest, s'], rows,
                     range(1, 6)).text()
    if content.topics.absent:
        yield from wrapped(f'missing: {", ".join(content.topics.absent)}', '')


def _flight(content: Content) -> Iterator[str]:
    rate = content.sample_rate_hz or 0.0
    lost = f'{content.lost_pct:.2g} % of the cycles lost'
    if content.longest_gap_s:
        lost += f', the longest gap {content.longest_gap_s:.3f} s'
    yield f'flight    {content.length_s:.1f} s at {rate:.4g} Hz, {lost}'
    if content.motors_at_limit_pct:
        shares = ', '.join(f'{share:.2g}' for share in content.motors_at_limit_pct)
        used = ' outside idle segments' if any(s.role == 'idle' for s in content.segments) else ''
        yield f'motors    at a limit for {shares} % of the time{used}'
    else:
        axes = 'known from the wrench only' if content.craft else 'not known, nor is the mixer'
        yield f'motors    not recorded: limits are {axes}'
    if content.craft:
        yield from wrapped(content.craft, '          ', first='craft     ')
    for line in content.rotors:
        yield from wrapped(line, '          ', first='rotors    ')
    for pattern in content.layout:
        yield from wrapped(pattern.sentence, '          ')
    if content.battery:
        b = content.battery
        yield f'battery   {b.first:.2f} V to {b.last:.2f} V, lowest {b.lowest:.2f} V'
    else:
        yield 'battery   not measured'
    axes = ', '.join(axis for axis in EVERY if any(
        name.startswith(f'{axis}.') for name in content.gains))
    if 'sensor.gyro_filter_hz' in content.gains:
        axes += ' and the gyro filter'
    yield f'gains     {"of " + axes if axes else "unknown (/gains/active is missing)"}'


def _segments(content: Content) -> Iterator[str]:
    note = ' (the bag names none: split in time)' if content.split else ''
    yield f'segments{note}'
    axes: dict[tuple[str, str, str, float, float, str], list[str]] = {}
    for s in content.segments:  # those of several axes at a time in one line
        ended = str(s.parameters.get('reason', ''))  # why the excitation before it did
        axes.setdefault((s.role, s.signal, s.injection, s.start_s, s.end_s, ended),
                        []).append(s.axis)
    for (role, signal, injection, start_s, end_s, ended), of in [*axes.items()][:MAX_SEGMENTS]:
        every = 'all' if len(of) > 1 and sorted(of) == sorted(AXES) else ', '.join(of)
        yield (f'  {role:<11} {signal:<10} {every:<6} {injection:<9} '
               f'{start_s:8.2f} to {end_s:8.2f} s')
        if ended:
            yield from wrapped(f'the excitation ended: {ended}', '              ')
    if len(axes) > MAX_SEGMENTS:
        yield f'  and {len(axes) - MAX_SEGMENTS} more (--json)'


def _axis(axis: AxisContent) -> Iterator[str]:
    yield (f'{axis.axis}: {axis.train_s:.1f} s to train, {axis.validation_s:.1f} s to validate, '
           f'{axis.windows} windows of 0.5 s')
    if axis.rate_rms is not None and axis.command_rms is not None:
        reference = '' if axis.reference_rms is None else f', reference {axis.reference_rms:.3g}'
        yield f'  RMS: rate {axis.rate_rms:.3g} rad/s, command {axis.command_rms:.3g}{reference}'
    if axis.excitation_order == 0:
        yield '  not excited: the command stands still'
    elif axis.excitation_order is not None:
        band = axis.coherent_band_rad_s
        span = f'{band[0]:.2g} to {band[1]:.3g} rad/s' if band else 'in no band'
        yield (f'  persistently exciting of order {axis.excitation_order}; '
               f'coherent {span}')
    for use in axis.uses:
        yield from _use(use)


def _use(use: Use) -> Iterator[str]:
    mark = 'yes' if use.possible else 'no '
    because = f': {use.because}' if use.because else ''
    yield from wrapped(f'{use.name}{because}', '      ', first=f'  {mark} ')
