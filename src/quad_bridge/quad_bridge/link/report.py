"""What the link says of itself in /diagnostics: port, frames, losses, clock. Pure sentences."""

from __future__ import annotations

from dataclasses import dataclass, replace

from quad_bridge.link.machine import Link
from quad_bridge.link.port import PortState, PortStatus
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_bridge.wire.framing import Counts

COARSE_S = 0.002
"""Where half a round trip is longer, so may the error of the stamps be."""
FTDI_MS = 2
SILENT_S = 3.0
"""Without an answer to TIMESYNC for so long the estimate ages."""
FOREIGN_BYTES = 2000
"""Bytes without one valid frame after which the aircraft is said to speak another protocol."""
SETTLED_S = 0.5
"""Least time over which rates and losses are told."""


@dataclass(frozen=True)
class _Since:
    """Figures at an earlier report, to tell rates and new losses."""

    time_s: float
    counts: Counts
    cycles: int
    dropped_writes: int = 0


class LinkReport:
    """Makes the entries `link` and `clock`; a report out of turn tells of the time before."""

    def __init__(self, link: Link, now_s: float) -> None:
        self._link = link
        self._opened = Counts()
        """The decoder's counts when the port was opened."""
        self._before = self._since = _Since(now_s, Counts(), 0)

    def opened(self) -> None:
        """The port was opened anew."""
        self._opened = replace(self._link.decoder.counts)

    def entries(
        self, port: PortStatus, now_s: float, *, behind_ns: int = 0, unset: bool = False
    ) -> list[Status]:
        """Both entries; `behind_ns`: by how much the system clock was set beyond the stamps.

        `unset`: time is simulated, and nobody has told it yet.
        """
        settled = now_s - self._since.time_s > SETTLED_S
        since = self._since if settled else self._before
        entries = [
            self._link_status(port, since, now_s),
            clock_status(self._link, behind_ns, unset=unset, now_s=now_s),
        ]
        if settled:
            counts, cycles = replace(self._link.decoder.counts), self._link.cycles
            self._before = since
            self._since = _Since(now_s, counts, cycles, port.dropped_writes)
        return entries

    def _link_status(self, port: PortStatus, since: _Since, now_s: float) -> Status:
        link, counts = self._link, self._link.decoder.counts
        rate = (link.cycles - since.cycles) / max(now_s - since.time_s, 1e-3)
        values = {
            'port': port.state.value,
            'port fault': port.detail,
            'device': port.path,
            'times opened': port.opened,
            'cycle rate (Hz)': f'{rate:.1f}',
            'cycles': link.cycles,
            'lost cycles': counts.lost_cycles,
            'bad CRC': counts.bad_crc,
            'garbage bytes': counts.garbage_bytes,
            'unknown messages': counts.unknown,
            'standard messages not used': counts.standard,
            'from other senders': counts.foreign,
            'implausible': counts.implausible,
            'MAVLink 1 messages': counts.old_version,
            'refused, unsigned': counts.unsigned,
            'refused, other key': counts.forged,
            'refused, replayed': counts.replayed,
            'refused, time ahead': counts.ahead,
            'restarts of the STM32': counts.restarts,
            'dropped writes': port.dropped_writes,
            'bytes': counts.bytes,
        }
        level, text = self._verdict(port, counts, since, now_s)
        return Status('link', level, text, values)

    def _verdict(
        self, port: PortStatus, counts: Counts, since: _Since, now_s: float
    ) -> tuple[int, str]:
        lost = counts.lost_cycles - since.counts.lost_cycles
        slow_ms = port.latency_ms if port.latency_ms is not None else 0
        if port.state is PortState.OPEN and counts.bytes != since.counts.bytes:
            if counts.frames == self._opened.frames:
                return self._no_frame(counts)
            if self._link.cycles == since.cycles:
                return self._no_cycle(round(1e9 * now_s))
        arrive = 'control cycles arrive'
        held = f'the FTDI adapter holds bytes for {slow_ms} ms: set latency_timer of {port.path}'
        return _first(
            (port.state is not PortState.OPEN, ERROR, f'port {port.state.value}'),
            (counts.bytes == since.counts.bytes, ERROR, 'port open, but nothing arrives'),
            (lost > 0, WARN, f'{lost} cycles lost since the last report'),
            (port.dropped_writes > since.dropped_writes, WARN,
             f'{arrive}, but the aircraft does not read what it is sent'),
            (slow_ms > FTDI_MS, WARN, f'{arrive}, but {held} to 1'),
            (True, OK, arrive),
        )  # fmt: skip

    def _no_frame(self, counts: Counts) -> tuple[int, str]:
        opened, garbage = self._opened, counts.bytes - self._opened.bytes
        return _first(
            (counts.unsigned > opened.unsigned, ERROR,
             'the aircraft does not sign: give it the key of key_file'),
            (counts.forged > opened.forged, ERROR,
             'the aircraft signs with another key than key_file'),
            (counts.ahead > opened.ahead, ERROR,
             "the aircraft signs with a time far ahead: set its clock, or this computer's"),
            (counts.replayed > opened.replayed, ERROR,
             'only old frames arrive: a recording, or an aircraft that does not take our time'),
            (counts.old_version > opened.old_version, ERROR,
             'speaks MAVLink 1: set it to MAVLink 2 (SERIALn_PROTOCOL, MAV_PROTO_VER)'),
            (garbage < FOREIGN_BYTES, WARN, 'bytes arrive, no valid frame yet'),
            (True, ERROR,
             f'speaks another protocol or baud rate: no valid frame in {garbage} bytes'),
        )  # fmt: skip

    def _no_cycle(self, now_ns: int) -> tuple[int, str]:
        names = ', '.join(self._link.autopilot.names)
        if not names:
            return ERROR, 'no control cycle since the last report'
        missing = ', '.join(self._link.autopilot.missing(now_ns))
        return WARN, (
            f'only standard MAVLink messages arrive ({names}): without QUAD_CYCLE there is no '
            f'{missing}; excitation and gains are refused'
        )


def clock_status(link: Link, behind_ns: int, *, unset: bool, now_s: float) -> Status:
    """How well device time is mapped to host time; see `LinkReport.entries`."""
    state = link.clock.state
    values = {
        'offset (s)': f'{state.offset_s:.6f}',
        'drift (ppm)': f'{state.drift_ppm:.2f}',
        'shortest round trip (ms)': f'{1e3 * state.round_trip_s:.3f}',
        'unseen asymmetry, at most (ms)': f'{500.0 * state.round_trip_s:.3f}',
        'round trips used': state.accepted,
        'round trips dropped': state.rejected,
        'restarts': state.restarts,
        'uneven steps of device time': link.stamping.guard.alarms,
        'wraps at 32 bits': link.stamping.device_time.wraps,
        'cycles held back': link.held,
    }
    level, text = _clock_verdict(link, behind_ns, unset=unset, now_s=now_s)
    return Status('clock', level, text, values)


def _clock_verdict(link: Link, behind_ns: int, *, unset: bool, now_s: float) -> tuple[int, str]:
    state, deaf = link.clock.state, 'no answer to TIMESYNC'
    if link.decoder.counts.unverified:
        deaf += ' (the aircraft signs: it heeds who has its key, see key_file)'
    silent_s = now_s - 1e-9 * link.answered_ns
    heard = state.accepted or state.rejected
    set_by = f'the system clock was set by {1e-9 * behind_ns:.3f} s'
    return _first(
        (unset, WARN, 'use_sim_time is set and nothing comes on /clock: nothing is published'),
        (behind_ns != 0, WARN, f'stamps still use the old time {set_by}'),
        (not state.converged, WARN,
         f'{"not converged" if heard else deaf}: nothing is published'),
        (state.one_way, WARN, f'{deaf}: stamps are arrivals, late by the transport'),
        (state.round_trip_s > 2.0 * COARSE_S, WARN,
         f'converged, but stamps may be off by up to {500.0 * state.round_trip_s:.1f} ms'),
        (silent_s > SILENT_S, WARN,
         f'converged, but {deaf} for {silent_s:.0f} s: does the aircraft hear us?'),
        (True, OK, 'converged'),
    )  # fmt: skip


def _first(*verdicts: tuple[bool, int, str]) -> tuple[int, str]:
    """Level and words of the first that holds."""
    return next((level, words) for holds, level, words in verdicts if holds)
