"""`serial_bridge --check`: one screen: is this PX4 or ArduPilot ready, and what to change.

Listens for some seconds, asks for rates and parameters as the bridge does, writes nothing, needs
no ROS. `report` is what it prints; the rest waits for the line.
"""

from __future__ import annotations

import argparse
import math
import threading
from collections.abc import Sequence

from quad_bridge.arguments import BAD_INPUT, OneLineParser, complain, positive, say
from quad_bridge.autopilots.aircraft import AutopilotAircraft, Connected
from quad_bridge.autopilots.kinds import Advice
from quad_bridge.gains.cycles import MIN_HZ
from quad_bridge.link.autopilot import LINE_SHARE, load
from quad_bridge.link.machine import Link
from quad_bridge.link.port import PortState, SerialPort, over_network
from quad_bridge.link.stamping import Arrived, Described, Stamped
from quad_bridge.lockstep import clock
from quad_bridge.motor_outputs import motor_outputs
from quad_bridge.wire import frames as f

FAST_HZ = 100.0  # with fewer rates a second the live bag shows neither lag nor delay
NOT_READY = 3  # exit status, beside 1 and 2 of the contract


def report(aircraft: AutopilotAircraft, link: Link, now_ns: int, craft: str) -> list[Advice]:
    """Findings, each with whether it is right and what to change."""
    kind, flight = aircraft.kind, aircraft.flight
    major, minor = aircraft.number
    version = f'{major}.{minor}' if major else 'of unknown version'
    rates_hz = {name: rate for name, (rate, _) in link.autopilot.rates(now_ns).items()}
    words = ', '.join(f'{name} {rate_hz:.0f}' for name, rate_hz in rates_hz.items())
    fastest = max(rates_hz.values(), default=0.0)
    capacity = link.autopilot.budget / LINE_SHARE / 1000.0
    read, sticks = len(aircraft.gains.active), not flight.sticks_fault(1e-9 * now_ns)
    return [
        (f'{kind.name} {version}, {craft}', bool(major),
         'it does not answer MAV_CMD_REQUEST_MESSAGE: is it older than 4.0?'),
        *([(f'Hz: {words}', True, '')] if words else []),
        *([(f'the line carries {capacity:.1f} kB/s: {load(rates_hz) / 1000:.1f} used', True, '')]
          if math.isfinite(capacity) else []),
        (f'rates for a live bag: {fastest:.0f} Hz', fastest >= FAST_HZ,
         f'below {FAST_HZ:g} Hz identify from the log on the card, or take 921600 baud'),
        (f'rates for the watch over gains: {fastest:.0f} Hz', fastest >= MIN_HZ,
         f'gains are refused below {MIN_HZ:g} Hz: a faster line is needed'),
        (f'{read} gains, limits and filters read', read > 0,
         'no answer to PARAM_REQUEST_READ: is the line one way only?'),
        (f'battery {flight.volts:.1f} V', math.isfinite(flight.volts),
         'no voltage: calibrate the power module'),
        ('the sticks are received' if sticks else 'the sticks are not received', sticks,
         'switch the transmitter on: without it nothing is excited and no gain is sent'),
        (f'mode {kind.mode_name(flight.mode)}', flight.mode in kind.pilot_modes,
         f'put {", ".join(kind.pilot_modes.values())} on the mode switch'),
        ('attitude set-points are reported' if flight.target is not None
         else 'no ATTITUDE_TARGET', flight.target is not None,
         'without it the excitation is not measured, and none is flown'),
        *kind.advice(aircraft.gains.values, aircraft.number),
    ]


def lines(advice: Sequence[Advice]) -> list[str]:
    """The screen."""
    out = []
    for what, is_met, remedy in advice:
        out.append(f'  {"ok" if is_met else "--"}  {what}' + (
            f': {remedy}' if remedy and not is_met else ''))
    bad = sum(not is_met for _, is_met, _ in advice)
    out.append('ready' if not bad else f'{bad} of {len(advice)} lines are not as they should be')
    return out


class _Listener:
    """The bridge's parts without topics, for as long as the check takes."""

    def __init__(self, port: str, baud: int) -> None:
        self.link = Link(baud=None if '://' in port else baud)
        self.connected = Connected(lambda: '', clock().now_s, allow_gains=False,
                                   allow_excitation=False)
        self.connected.on_change = self._on_change
        self.craft = 'a craft that it does not describe'
        self._lock = threading.Lock()
        self.port = SerialPort(port, baud, self._on_bytes, self.link.opened)

    def _on_change(self, aircraft: object) -> None:
        if isinstance(aircraft, AutopilotAircraft):
            self.link.autopilot.also_hz = aircraft.kind.requested_hz

    def _on_bytes(self, data: bytes) -> None:
        now_ns = clock().now_ns()
        with self._lock:
            for event in self.link.receive(data, now_ns):
                if isinstance(event, Arrived | Stamped):
                    self._take(event.frame, now_ns)
                elif isinstance(event, Described):
                    outputs = motor_outputs(event.peer.autopilot, self.link.name,
                                            event.parameters)
                    if outputs.craft is not None and self.connected.autopilot is not None:
                        self.craft = outputs.craft.name
                        self.connected.autopilot.describe(outputs.craft)
            self._send(now_ns)

    def _take(self, frame: object, now_ns: int) -> None:
        self.connected.take(frame, 1e-9 * now_ns)
        if isinstance(frame, f.ParamValue) and self.connected.autopilot is not None:
            self.connected.aircraft.gains.take(frame, 1e-9 * now_ns)

    def _send(self, now_ns: int) -> None:
        aircraft = self.connected.autopilot
        if aircraft is not None and aircraft.gains.reading:
            request = aircraft.gains.poll(1e-9 * now_ns)
            if request is not None:
                self.link.send(request)
        for frame in self.connected.poll(1e-9 * now_ns):
            self.link.send(frame)
        data = self.link.to_send()
        if data:
            self.port.write(data)

    def tick(self) -> None:
        """Ask what is due."""
        with self._lock:
            now_ns = clock().now_ns()
            self.link.tick(now_ns)
            self._send(now_ns)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the screen; 0 ready, 3 not ready, 2 where nobody is there."""
    parser = OneLineParser(
        prog='serial_bridge --check',
        description='Whether a PX4 or ArduPilot on this line is ready, and what to change.',
        epilog='Example: ros2 run quad_bridge serial_bridge --check --port /dev/ttyACM0',
    )
    parser.add_argument('--check', action='store_true', help=argparse.SUPPRESS)
    parser.add_argument('--port', default='/dev/ttyACM0',
                        help='as the parameter port; default %(default)s')
    parser.add_argument('--baud', type=int, default=921600,
                        help='of a serial line; default %(default)s')
    parser.add_argument('--seconds', type=positive, default=12.0, help='to listen; default 12')
    options = parser.parse_args(argv)
    if over_network(options.port):
        complain(f'serial_bridge: --port {options.port}: leads to another computer; check on the '
                 "aircraft's own\n")
        return BAD_INPUT
    listener = _Listener(options.port, options.baud)
    listener.port.start()
    pause, until_s = threading.Event(), clock().now_s() + options.seconds
    while clock().now_s() < until_s and not listener.port.status.refused:
        pause.wait(0.05)
        listener.tick()
    aircraft, port = listener.connected.autopilot, listener.port.status
    listener.port.stop()
    if aircraft is None:
        words = ('neither PX4 nor ArduPilot answers; check port and baud rate (an STM32 with this '
                 "project's firmware needs no --check)")
        if port.opened == 0 and port.state is not PortState.OPEN:
            words = f'port {port.state.value}'
        complain(f'serial_bridge: {options.port}: {words}\n')
        return BAD_INPUT
    advice = report(aircraft, listener.link, clock().now_ns(), listener.craft)
    say('\n'.join(lines(advice)) + '\n')
    return 0 if all(is_met for _, is_met, _ in advice) else NOT_READY
