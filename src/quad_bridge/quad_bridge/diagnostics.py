"""What the bridge says of itself in /diagnostics: link, clock, gains, excitation. Pure sentences.

Levels are diagnostic_msgs' (0 OK, 1 WARN, 2 ERROR); the node puts them into messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.gain_keeper import GainKeeper
from quad_bridge.gain_state import State
from quad_bridge.link import Link
from quad_bridge.serial_port import PortState, PortStatus
from quad_bridge.sparing import Sparing
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_bridge.wire.codec import Counts
from quad_bridge.wire.frames import Flag

COARSE_S = 0.002
"""Where half a round trip is longer, so may the error of the stamps be."""
FTDI_MS = 2
SILENT_S = 3.0
"""Without an answer to TIMESYNC for so long the estimate ages."""
FOREIGN_BYTES = 2000
"""Bytes without one valid frame after which the far end is said to speak another protocol."""


@dataclass(frozen=True)
class Since:
    """Figures at the last report, to tell rates and new losses."""

    time_s: float
    counts: Counts
    cycles: int
    dropped_writes: int = 0


class Changes:
    """Says a state when it begins, not every second."""

    def __init__(self, sparing: Sparing) -> None:
        self._sparing = sparing
        self._told: dict[str, str] = {}

    def new(self, entries: list[Status], now_s: float) -> list[Status]:
        """Those whose message is another one than before, and may be logged."""
        begun = [e for e in entries if self._told.get(e.name) != e.message]
        self._told.update({e.name: e.message for e in begun})
        return [e for e in begun if self._sparing.allow(e.name + e.message, now_s)]


def callback_entries(failed: int, lately: int) -> list[Status]:
    """Of callbacks that failed and were left out, all and since the last report; maybe none."""
    if not failed:
        return []
    level, text = OK, 'no callback has failed since the last report'
    if lately:
        level, text = WARN, f'{lately} callbacks failed since the last report: see the log'
    return [Status('callbacks', level, text, {'failed callbacks': failed})]


def link_status(
    port: PortStatus, link: Link, since: Since, now_s: float, opened: Counts
) -> Status:
    """Port, frames and losses; `opened` are the decoder's counts when the port was opened."""
    counts = link.decoder.counts
    seconds = max(now_s - since.time_s, 1e-3)
    rate = (link.cycles - since.cycles) / seconds
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
    level, text = _link_verdict(port, link, counts, since, opened, now_s)
    return Status('link', level, text, values)


def _link_verdict(
    port: PortStatus, link: Link, counts: Counts, since: Since, opened: Counts, now_s: float
) -> tuple[int, str]:
    if port.state is not PortState.OPEN:
        return ERROR, f'port {port.state.value}'
    if counts.bytes == since.counts.bytes:
        return ERROR, 'port open, but nothing arrives'
    if counts.frames == opened.frames:
        return _no_frame(counts, opened)
    if link.cycles == since.cycles:
        return _no_cycle(link, round(1e9 * now_s))
    lost = counts.lost_cycles - since.counts.lost_cycles
    return _flowing(port, lost, port.dropped_writes - since.dropped_writes)


def _flowing(port: PortStatus, lost: int, dropped: int) -> tuple[int, str]:
    if lost:
        return WARN, f'{lost} cycles lost since the last report'
    if dropped > 0:
        return WARN, 'control cycles arrive, but the far end does not read what it is sent'
    if port.latency_ms is not None and port.latency_ms > FTDI_MS:
        return WARN, (
            f'control cycles arrive, but the FTDI adapter holds bytes for {port.latency_ms} ms: '
            f'set latency_timer of {port.path} to 1'
        )
    return OK, 'control cycles arrive'


def _no_speaker(counts: Counts, opened: Counts) -> str:
    """Where frames come, but none that may speak: why."""
    if counts.unsigned > opened.unsigned:
        return 'the far end does not sign: give it the key of key_file'
    if counts.forged > opened.forged:
        return 'the far end signs with another key than key_file'
    if counts.ahead > opened.ahead:
        return "the far end signs with a time far ahead: set its clock, or this computer's"
    if counts.replayed > opened.replayed:
        return 'only old frames arrive: a recording, or a far end that does not take our time'
    return ''


def _no_frame(counts: Counts, opened: Counts) -> tuple[int, str]:
    refused, garbage = _no_speaker(counts, opened), counts.bytes - opened.bytes
    if refused:
        return ERROR, refused
    if counts.old_version > opened.old_version:
        return ERROR, 'speaks MAVLink 1: set it to MAVLink 2 (SERIALn_PROTOCOL, MAV_PROTO_VER)'
    if garbage < FOREIGN_BYTES:
        return WARN, 'bytes arrive, no valid frame yet'
    text = f'speaks another protocol or baud rate: no valid frame in {garbage} bytes'
    return ERROR, text


def _no_cycle(link: Link, now_ns: int) -> tuple[int, str]:
    names = ', '.join(link.autopilot.names)
    if not names:
        return ERROR, 'no control cycle since the last report'
    missing = ', '.join(link.autopilot.missing(now_ns))
    return WARN, (
        f'only standard MAVLink messages arrive ({names}): without QUAD_CYCLE there is no '
        f'{missing}; excitation and gains are refused'
    )


def clock_status(
    link: Link, behind_ns: int = 0, *, unset: bool = False, now_ns: int = 0
) -> Status:
    """How well device time is mapped to host time; `behind_ns` by how much that was set since.

    `unset`: time is simulated, and nobody has told it yet. `now_ns` of the steady clock tells how
    long no round trip has come.
    """
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
    if unset or behind_ns:
        set_by = f'the system clock was set by {1e-9 * behind_ns:.3f} s'
        silent = 'use_sim_time is set and nothing comes on /clock: nothing is published'
        text = silent if unset else f'stamps keep the time of before {set_by}'
        return Status('clock', WARN, text, values)
    deaf = 'no answer to TIMESYNC'
    if link.decoder.counts.unverified:
        deaf += ' (the far end signs: it heeds who has its key, see key_file)'
    if state.one_way and state.converged:
        text = f'{deaf}: stamps are arrivals, late by the transport'
        return Status('clock', WARN, text, values)
    if state.converged:
        silent_s, but = 1e-9 * (now_ns - link.answered_ns), ''
        if state.round_trip_s > 2.0 * COARSE_S:
            but = f', but stamps may be off by up to {500.0 * state.round_trip_s:.1f} ms'
        elif silent_s > SILENT_S:
            but = f', but {deaf} for {silent_s:.0f} s: does the far end hear us?'
        return Status('clock', WARN if but else OK, f'converged{but}', values)
    if state.accepted == 0 and state.rejected == 0:
        return Status('clock', WARN, f'{deaf}: nothing is published', values)
    return Status('clock', WARN, 'not converged: nothing is published', values)


def gains_status(link: Link, keeper: GainKeeper) -> Status:
    """State of the parameters, the last refusal or roll-back, and what is watched."""
    values: dict[str, object] = {n: f'{v:.9g}' for n, v in link.gains.active.items()}
    values['writes acknowledged'] = keeper.commits
    values['refused'] = keeper.refusals
    values['rolled back'] = keeper.rollbacks
    values['polarity'] = keeper.polarity.words()
    values |= {f'watch {n} (rad/s)': f'{v:.3f}' for n, v in keeper.watch.figures().items()}
    if link.last_cycle is None and link.autopilot.asked:
        return Status('gains', WARN, 'refused: the far end has no QUAD_GAINS', values)
    if keeper.refused:
        return Status('gains', ERROR, keeper.refused, values)
    if keeper.disk_fault:
        return Status('gains', WARN, keeper.disk_fault, values)
    if keeper.state is State.IDLE and not link.gains.reader.complete:
        return Status('gains', WARN, 'the STM32 has not reported its parameters yet', values)
    return Status('gains', OK, keeper.words, values)


def diagnostic_array(node: str, hardware: str, stamp: Any, entries: list[Status]) -> Any:
    """The message of all entries, named `<node>: <entry>`."""
    array = DiagnosticArray()
    array.header.stamp = stamp
    array.status = [
        DiagnosticStatus(
            name=f'{node}: {entry.name}',
            level=bytes([entry.level]),
            message=entry.message,
            hardware_id=hardware,
            values=[KeyValue(key=k, value=str(v)) for k, v in entry.values.items()],
        )
        for entry in entries
    ]
    return array


def excitation_status(relay: ExcitationRelay, link: Link, disabled: str = '') -> Status:
    """What is forwarded and what the STM32 does with it; `disabled` the operator's fault."""
    last = link.last_cycle
    flags = Flag(last.flags) if last is not None else Flag.NONE
    values = {
        'injection': relay.injection.name.lower(),
        'set-points forwarded': relay.forwarded,
        'set-points dropped': relay.dropped,
        'flags of the STM32': ' '.join(str(f.name).lower() for f in Flag if f and f in flags),
    }
    if relay.reason:
        return Status('excitation', WARN, f'set-point dropped: {relay.reason}', values)
    if Flag.STALE_SETPOINT in flags:
        return Status('excitation', WARN, 'the STM32 dropped a stale set-point', values)
    if Flag.EXCITATION_REFUSED in flags:
        return Status('excitation', WARN, 'the STM32 refuses the excitation', values)
    if disabled:
        return Status('excitation', OK, f'disabled: {disabled}', values)
    running = Flag.EXCITATION in flags
    return Status('excitation', OK, 'running' if running else 'idle', values)
