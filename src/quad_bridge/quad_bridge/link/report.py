"""The link's entries in /diagnostics: port, frames, losses, clock. Pure."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from quad_bridge.link.machine import Link
from quad_bridge.link.port import PortState, PortStatus
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_bridge.wire.framing import Counts

COARSE_S = 0.002  # where half a round trip is longer, so may the error of the stamps be
FTDI_MS = 2
SILENT_S = 3.0  # without an answer to TIMESYNC for so long the estimate ages
FOREIGN_BYTES = 2000  # without one valid frame: the aircraft speaks another protocol
MIN_REPORT_S = 0.5  # least time over which rates and losses are counted
_COUNTED = {
    'lost cycles': 'lost_cycles', 'bad CRC': 'bad_crc', 'garbage bytes': 'garbage_bytes',
    'unknown messages': 'unknown', 'standard messages not used': 'standard',
    'from other senders': 'foreign', 'implausible': 'implausible',
    'MAVLink 1 messages': 'old_version', 'refused, unsigned': 'unsigned',
    'refused, other key': 'forged', 'refused, replayed': 'replayed',
    'refused, time ahead': 'ahead', 'restarts of the aircraft': 'restarts', 'bytes': 'bytes',
}  # fmt: skip
"""Name in /diagnostics to the field of Counts."""
_UNHEARD = {
    'unsigned': 'the aircraft does not sign: give it the key of key_file',
    'forged': 'the aircraft signs with another key than key_file',
    'ahead': "the aircraft signs with a time far ahead: set its clock, or this computer's",
    'replayed': 'only old frames arrive: a replay, or an aircraft whose clock lags behind ours',
    'old_version': 'speaks MAVLink 1: set it to MAVLink 2 (SERIALn_PROTOCOL, MAV_PROTO_VER)',
}
"""Counts since the last report, and the reason if no frame was accepted since."""


class _Before(NamedTuple):
    """Figures at an earlier report, from which rates and new losses follow."""

    time_s: float
    counts: Counts
    cycles: int = 0
    dropped_writes: int = 0


class LinkReport:
    """Makes the entries `link` and `clock`; an early report repeats the last figures."""

    def __init__(self, link: Link, now_s: float) -> None:
        self._link = link
        self._opened = Counts()  # the decoder's when the port was opened
        self._earlier = self._last = _Before(now_s, Counts())

    def opened(self) -> None:
        """Reset after the port was reopened."""
        self._opened = replace(self._link.decoder.counts)

    def entries(
        self, port: PortStatus, now_s: float, *, behind_ns: int = 0, unset: bool = False
    ) -> list[Status]:
        """Both entries; `behind_ns`: by how much the system clock was set beyond the stamps.

        `unset`: time is simulated, and it is not known yet.
        """
        link, counts = self._link, self._link.decoder.counts
        due = now_s - self._last.time_s > MIN_REPORT_S
        previous = self._last if due else self._earlier
        if due:
            now = _Before(now_s, replace(counts), link.cycles, port.dropped_writes)
            self._earlier, self._last = previous, now
        rate = (link.cycles - previous.cycles) / max(now_s - previous.time_s, 1e-3)
        values = {
            'port': port.state.value,
            'port fault': port.detail,
            'device': port.path,
            'times opened': port.opened,
            'dropped writes': port.dropped_writes,
            'cycle rate (Hz)': f'{rate:.1f}',
            'cycles': link.cycles,
            **{name: getattr(counts, field) for name, field in _COUNTED.items()},
            'aircraft': link.name,
        }
        if link.cycles == previous.cycles:
            values |= {
                f'{name} (Hz)': f'{rate_hz:.1f} of {requested_hz:.0f}'
                for name, (rate_hz, requested_hz)
                in link.autopilot.rates(round(1e9 * now_s)).items()
            }
        level, text = self._verdict(port, counts, previous, now_s)
        clock = clock_status(link, behind_ns, unset=unset, now_s=now_s)
        return [Status('link', level, text, values), clock]

    def _verdict(
        self, port: PortStatus, counts: Counts, before: _Before, now_s: float
    ) -> tuple[int, str]:
        lost = counts.lost_cycles - before.counts.lost_cycles
        level, text = WARN, 'control cycles arrive'
        if port.state is not PortState.OPEN:
            level, text = ERROR, f'port {port.state.value}'
        elif counts.bytes == before.counts.bytes:
            level, text = ERROR, 'port open, but nothing arrives'
        elif counts.frames == before.counts.frames and (why := _refused(counts, before.counts)):
            level, text = ERROR, why
        elif counts.frames == self._opened.frames:
            garbage = counts.bytes - self._opened.bytes
            text = 'bytes arrive, no valid frame yet'
            if garbage >= FOREIGN_BYTES:
                level = ERROR
                text = f'speaks another protocol or baud rate: no valid frame in {garbage} bytes'
        elif self._link.cycles == before.cycles:
            level, text = self._no_cycle(round(1e9 * now_s))
        elif lost > 0:
            text = f'{lost} cycles lost since the last report'
        elif port.dropped_writes > before.dropped_writes:
            text += ', but the aircraft does not read what it is sent'
        elif port.latency_ms is not None and port.latency_ms > FTDI_MS:
            text += f', but the FTDI adapter holds bytes for {port.latency_ms} ms'
            text += f': set latency_timer of {port.path} to 1'
        else:
            level = OK
        return level, text

    def _no_cycle(self, now_ns: int) -> tuple[int, str]:
        link, autopilot = self._link, self._link.autopilot
        if not autopilot.names:
            return ERROR, 'no control cycle since the last report'
        missing = ', '.join(autopilot.missing(now_ns))
        only = f'{link.name} sends standard MAVLink messages only'
        words = [f'{only}: without QUAD_CYCLE there is no {missing}']
        if not autopilot.also_hz:
            words.append('excitation and gains are refused')
        if autopilot.without_rates:
            words.append('its rates are exactly zero while the angles move: marked unknown')
        slow = autopilot.slow_ones(now_ns)
        if slow:
            why = ('another program on the line lowers them again' if autopilot.lowered & set(slow)
                   else 'the line is too slow, or the autopilot gives no more')
            words.append(f'{", ".join(slow)} rarer than asked for: {why}')
        return WARN, '; '.join(words)


def _refused(counts: Counts, before: Counts) -> str:
    """Why frames that have come since were not accepted; empty where none came."""
    return next((words for name, words in _UNHEARD.items()
                 if getattr(counts, name) > getattr(before, name)), '')


def clock_status(link: Link, behind_ns: int, *, unset: bool, now_s: float) -> Status:
    """Quality of the map from device to host time; see `LinkReport.entries`."""
    clock = link.clock
    values = {
        'offset (s)': f'{1e-9 * clock.offset_ns:.6f}',
        'drift (ppm)': f'{1e6 * clock.drift:.2f}',
        'shortest round trip (ms)': f'{1e3 * clock.round_trip_s:.3f}',
        'unseen asymmetry, at most (ms)': f'{500.0 * clock.round_trip_s:.3f}',
        'round trips used': clock.accepted,
        'round trips dropped': clock.rejected,
        'restarts': clock.restarts,
        'uneven steps of device time': link.stamping.guard.alarms,
        'wraps at 32 bits': link.stamping.device_time.wraps,
        'cycles held back': link.stamping.withheld,
        'false times, dropped': link.stamping.false_times,
    }
    deaf, age_s = 'no answer to TIMESYNC', now_s - 1e-9 * link.answered_ns
    if age_s <= SILENT_S and not math.isnan(clock.too_long_s):
        deaf = f'TIMESYNC takes {1e3 * clock.too_long_s:.0f} ms there and back, more than 10'
    if link.decoder.counts.unverified:
        deaf += ' (the aircraft signs its frames and answers only who has its key: set key_file)'
    level, text = WARN, ''
    if unset:
        text = 'use_sim_time is set and nothing comes on /clock: nothing is published'
    elif behind_ns:
        set_by = f'the system clock was set by {1e-9 * behind_ns:.3f} s'
        text = f'stamps still use the old time: {set_by}'
    elif not clock.converged:
        answered = math.isnan(clock.too_long_s) and (clock.accepted or clock.rejected)
        text = f'{"not converged" if answered else deaf}: nothing is published'
    elif clock.one_way:
        text = f'{deaf}: stamps are times of arrival, late by the transport'
    elif clock.round_trip_s > 2.0 * COARSE_S:
        text = f'converged, but stamps may be off by up to {500.0 * clock.round_trip_s:.1f} ms'
    elif age_s > SILENT_S:
        text = f'converged, but {deaf} for {age_s:.0f} s: does the aircraft hear us?'
    else:
        level, text = OK, 'converged'
    return Status('clock', level, text, values)
