"""The process `virtual_stm32`: arguments, real time, pty, signals. Wiring only.

Device time runs with the host's monotonic clock. After a stall the missed cycles are run at once,
so that device time and cycle counter stay exact. With `--lockstep` device time is the clock of all
the processes that take part, and waits for them.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from quad_bridge.arguments import (
    BAD_INPUT,
    INTERRUPTED,
    OneLineParser,
    one_line,
    positive,
    say,
    seed,
)
from quad_bridge.errors import QuadBridgeError
from quad_bridge.key_file import signing_from
from quad_bridge.lockstep import START_NS, Line
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.control import INPUTS
from quad_bridge.virtual.effect_module import load_effect
from quad_bridge.virtual.endpoint import Endpoint
from quad_bridge.virtual.profile import Profile, load_profile, profile_names
from quad_bridge.virtual.pseudo_terminal import PseudoTerminal
from quad_bridge.virtual.receiver import Receiver, read_events

WAIT_S = 0.5
"""How long a signal may have to wait in lockstep."""
MAX_BURST = 50
"""Cycles that are run at once after a stall before the port is looked at again."""


def arguments() -> argparse.ArgumentParser:
    """The command line of `virtual_stm32`."""
    parser = OneLineParser(
        prog='virtual_stm32',
        description='A simulated quadrotor with its STM32 behind a pseudo-terminal, in real time.',
        epilog='Example: virtual_stm32 --profile plain --mount rig --axis roll --link /tmp/stm32',
    )
    known = ', '.join(profile_names())
    parser.add_argument(
        '--profile', default='plain', help=f'name ({known}) or YAML file; default plain'
    )
    parser.add_argument(
        '--mount', choices=('rig', 'hover'), help='one free axis on a bearing, or free flight'
    )
    parser.add_argument('--axis', choices=('roll', 'pitch', 'yaw'), help="the rig's free axis")
    parser.add_argument('--seed', type=seed, default=1, help='of all noise; default 1')
    parser.add_argument(
        '--effect-module',
        type=Path,
        metavar='FILE.py',
        help='adds the torque of its effect(t_s, rates, angles, thrusts, battery_v), N m',
    )
    parser.add_argument(
        '--rc-events',
        type=Path,
        metavar='FILE.yaml',
        help='stick movements: a list of {time_s: 3.0, channel: roll, value: 0.4}',
    )
    parser.add_argument(
        '--key', type=Path, metavar='FILE', help='sign, and ignore whoever does not (make_key)'
    )
    parser.add_argument('--link', type=Path, help='symbolic link to make to the port')
    parser.add_argument(
        '--lockstep',
        type=Path,
        metavar='SOCKET',
        help='simulated time that waits for the nodes started with QUAD_LOCKSTEP=SOCKET',
    )
    parser.add_argument('--duration', type=positive, metavar='S', help='end after so many seconds')
    return parser


def build_endpoint(given: argparse.Namespace) -> Endpoint:
    """The endpoint that the arguments ask for; kernels are compiled on return."""
    profile = load_profile(given.profile)
    profile = replace(profile, mount=given.mount or profile.mount, axis=given.axis or profile.axis)
    effect = None if given.effect_module is None else load_effect(given.effect_module)
    events = Receiver() if given.rc_events is None else read_events(given.rc_events)
    signing = signing_from(given.key)
    script = Receiver(events=profile.receiver.events + events.events)
    say('virtual STM32 prepares (some 15 s the first time, to compile)\n')
    _warm_up(profile, python_effect=effect is not None)
    return Endpoint(Aircraft(profile, seed=given.seed, effect=effect), script, signing)


def _warm_up(profile: Profile, *, python_effect: bool) -> None:
    """Compile (or load) the kernels before time starts to run."""

    def nothing(*_: object) -> np.ndarray:
        return np.zeros(3)

    Aircraft(profile, seed=0, effect=nothing if python_effect else None).run(np.zeros((1, INPUTS)))


class Stop:
    """Whether a signal, or the duration, has ended the run."""

    def __init__(self, endpoint: Endpoint, duration_s: float | None) -> None:
        self._aircraft, self._signalled = endpoint.aircraft, False
        self.last = None if duration_s is None else round(duration_s / endpoint.aircraft.cycle_s)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._take)

    def _take(self, _number: int, _frame: object) -> None:
        self._signalled = True

    def __bool__(self) -> bool:
        return self._signalled or (self.last is not None and self._aircraft.cycle >= self.last)


def serve(endpoint: Endpoint, port: PseudoTerminal, duration_s: float | None) -> None:
    """Run control cycles on their absolute schedule until a signal or the duration ends it."""
    stop, cycle_s = Stop(endpoint, duration_s), endpoint.aircraft.cycle_s
    start = time.monotonic_ns()
    while not stop:
        due_s = endpoint.aircraft.cycle * cycle_s
        now_ns = time.monotonic_ns() - start
        data = port.read(due_s - now_ns * 1e-9)
        now_ns = time.monotonic_ns() - start
        if data:
            answer = endpoint.receive(data, now_ns)
            if answer:
                port.write(answer)
        for _ in range(MAX_BURST):
            cycle = endpoint.aircraft.cycle
            if cycle * cycle_s > now_ns * 1e-9 or cycle == stop.last:
                break
            port.write(endpoint.cycle())


def serve_in_lockstep(
    endpoint: Endpoint, port: PseudoTerminal, line: Line, duration_s: float | None
) -> None:
    """Run each control cycle as soon as all who take part are ready for it."""
    stop, now_ns = Stop(endpoint, duration_s), 0
    while not stop:
        line.attend(0.0 if line.ready else WAIT_S, port.number)
        data = port.read(0.0)
        answer = endpoint.receive(data, now_ns) if data else b''
        if answer:
            port.write(answer)
        if line.ready:
            now_ns = round(endpoint.aircraft.cycle * endpoint.aircraft.cycle_s * 1e9)
            line.tell(START_NS + now_ns)
            port.write(endpoint.cycle())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the virtual STM32; 0 when ended by signal or duration, 2 on bad input.

    130 where it was interrupted before it ran.
    """
    given = arguments().parse_args(argv)
    try:
        endpoint = build_endpoint(given)
        port = PseudoTerminal(given.link)
        try:
            say(f'virtual STM32 on {port.path}\n')
            if given.lockstep is None:
                serve(endpoint, port, given.duration)
            else:
                with contextlib.closing(Line(given.lockstep, say)) as line:
                    serve_in_lockstep(endpoint, port, line, given.duration)
        finally:
            port.close()
        if port.dropped_bytes:
            say(f'{port.dropped_bytes} bytes dropped: nobody read them\n')
    except (QuadBridgeError, OSError) as error:
        sys.stderr.write(f'virtual_stm32: {one_line(error)}\n')
        return BAD_INPUT
    except KeyboardInterrupt:  # before `serve` takes the signal, as while compiling
        sys.stderr.write('virtual_stm32: interrupted\n')
        return INTERRUPTED
    return 0


if __name__ == '__main__':
    sys.exit(main())
