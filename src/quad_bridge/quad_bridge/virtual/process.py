"""The process `virtual_stm32`: arguments, the firmware's process, physics, signals. Wiring only.

The firmware is a process of its own that has the pseudo-terminal (board.py): the Linux build of
firmware/, or the STM32's ELF in QEMU. Its second line carries sensors and motors (hil.py). Device
time runs with the host's monotonic clock; after a stall the missed cycles are run at once, so that
device time and cycle counter stay exact. With `--lockstep` device time is the clock of all the
processes that take part, and waits for them.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import signal
import sys
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
from quad_bridge.lockstep import START_NS
from quad_bridge.si import FloatArray
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import Aircraft, EffectFunction, boot
from quad_bridge.virtual.board import ELF, Board, EmulatedBoard, EndedError
from quad_bridge.virtual.errors import ConfigurationError, RestartedError
from quad_bridge.virtual.line import Line
from quad_bridge.virtual.native import built_file
from quad_bridge.virtual.profile import Profile, load_profile, profile_names
from quad_bridge.virtual.receiver import Receiver, channels_at

WAIT_S = 0.5  # how long a signal may have to wait in lockstep


def arguments() -> argparse.ArgumentParser:
    """The command line of `virtual_stm32`."""
    parser = OneLineParser(
        prog='virtual_stm32',
        description='A simulated quadrotor with its STM32 behind a pseudo-terminal, in real time.',
        epilog='Example: virtual_stm32 --profile plain --mount rig --axis roll --link /tmp/stm32',
    )
    names = ', '.join(profile_names())
    parser.add_argument(
        '--profile', default='plain', help=f'name ({names}) or YAML file; default plain'
    )
    parser.add_argument(
        '--mount', choices=('rig', 'hover'), help='one free axis on a bearing, or free flight'
    )
    parser.add_argument('--axis', choices=('roll', 'pitch', 'yaw'), help="the rig's free axis")
    parser.add_argument('--seed', type=seed, default=1, help='seed of all noise; default 1')
    parser.add_argument(
        '--effect-module',
        type=Path,
        metavar='FILE.py',
        help='adds the torque of its effect(t_s, rates, angles, thrusts, battery_v), N m',
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
    parser.add_argument(
        '--qemu', action='store_true', help="fly the STM32's own ELF in QEMU (make qemu)"
    )
    parser.add_argument('--duration', type=positive, metavar='S', help='end after so many seconds')
    return parser


class Flight:
    """A prepared aircraft on its board, cycle by cycle; device time runs from here on."""

    def __init__(self, aircraft: Aircraft, board: Board, *, lockstep: bool) -> None:
        self.aircraft, self._board = aircraft, board
        board.motors()  # it listens
        board.send(boot(aircraft.profile, lockstep=lockstep).frame())
        self._frame = self._measured()

    def cycle(self) -> None:
        """Run one, which begins when it is due; RestartedError where the firmware began anew."""
        self._board.send(self._frame)
        motors = self._board.motors()
        if self.aircraft.cycle and not motors.time_us:  # it says that it listens, as at first
            raise RestartedError(self.aircraft.cycle)
        self.aircraft.move(motors)
        self._frame = self._measured()

    def _measured(self) -> bytes:
        now_s = self.aircraft.cycle * self.aircraft.cycle_s
        return self.aircraft.measure(channels_at(self.aircraft.profile.receiver, now_s))


class Stop:
    """Whether a signal, or the duration, has ended the run."""

    def __init__(self, aircraft: Aircraft, duration_s: float | None) -> None:
        self._aircraft, self._signalled = aircraft, False
        self._last = None if duration_s is None else round(duration_s / aircraft.cycle_s)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._take)

    def _take(self, _number: int, _frame: object) -> None:
        self._signalled = True

    def __bool__(self) -> bool:
        return self._signalled or (self._last is not None and self._aircraft.cycle >= self._last)


def fly_in_lockstep(flight: Flight, board: Board, line: Line, stop: Stop) -> None:
    """Run each control cycle as soon as all who take part are ready for it."""
    while not stop:
        line.attend(0.0 if line.ready else WAIT_S)
        if line.ready:
            now_s = flight.aircraft.cycle * flight.aircraft.cycle_s
            line.tell(START_NS + round(now_s * 1e9))
            flight.cycle()
        elif not board.running:
            raise EndedError


def build_aircraft(args: argparse.Namespace) -> Aircraft:
    """The aircraft that the arguments ask for, prepared."""
    profile = load_profile(args.profile)
    profile = replace(profile, mount=args.mount or profile.mount, axis=args.axis or profile.axis)
    effect = None if args.effect_module is None else load_effect(args.effect_module)
    say('virtual STM32 prepares\n')
    return prepared(profile, seed=args.seed, effect=effect)


def load_effect(path: Path) -> EffectFunction:
    """The checked function `effect` of a user's file; ConfigurationError names the file.

    It is called before every physics step with scalars in s and V and arrays of 3 (rad/s), 3 (rad)
    and 4 (N); it returns an extra body torque (3,) in N m, held over the step.
    """
    spec = importlib.util.spec_from_file_location('virtual_stm32_effect', path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ConfigurationError(str(path), 'is not a readable Python file (.py)')
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(str(path), f'cannot be loaded: {_named(error)}') from error
    function = getattr(module, 'effect', None)
    if not callable(function):
        raise ConfigurationError(
            str(path), 'has no function effect(t_s, rates, angles, thrusts, battery_v)'
        )
    return checked(function, str(path))


def checked(function: EffectFunction, name: str) -> EffectFunction:
    """`function` with its result held to three finite numbers; errors name `name`."""

    def effect(
        t_s: float, rates: FloatArray, angles: FloatArray, thrusts: FloatArray, battery_v: float
    ) -> FloatArray:
        try:
            returned = function(t_s, rates, angles, thrusts, battery_v)
            torque = np.array(returned, dtype=np.float64)
        except (Exception, SystemExit) as error:
            raise ConfigurationError(
                name, f'effect() at t = {t_s:.3f} s: {_named(error)}'
            ) from error
        if torque.shape != (3,) or not np.isfinite(torque).all():
            raise ConfigurationError(
                name,
                f'effect() at t = {t_s:.3f} s must return three finite torques in N m, '
                f'returned {str(returned)[:80]}',
            )
        return torque

    return effect


def _named(error: BaseException) -> str:
    return f'{type(error).__name__}: {error}'


def prepared(profile: Profile, *, seed: int, effect: EffectFunction | None = None) -> Aircraft:
    """An aircraft whose kernels are compiled, or loaded: device time must not wait for that.

    A compilation takes seconds, after which the missed cycles are more than a port holds.
    """
    no_effect = None if effect is None else lambda *_: np.zeros(3)
    first = Aircraft(profile, seed=0, effect=no_effect)
    first.measure(channels_at(Receiver(), 0.0))
    first.move(hil.Motors(0, (0.0, 0.0, 0.0, 0.0), 0, 0, 0))
    return Aircraft(profile, seed=seed, effect=effect)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the virtual STM32; 0 when ended by signal or duration, 2 on bad input.

    130 where it was interrupted before it ran.
    """
    args = arguments().parse_args(argv)
    try:
        signing_from(args.key)
        aircraft = build_aircraft(args)
        sys.stdout.flush()
        stop = Stop(aircraft, args.duration)  # its port appears, and whoever waits may signal
        board = board_of(args)
        try:
            fly(aircraft, board, args, stop)
        finally:
            status = board.close()
    except (QuadBridgeError, OSError) as error:
        sys.stderr.write(f'virtual_stm32: {one_line(error)}\n')
        return BAD_INPUT
    except KeyboardInterrupt:  # before `fly` takes the signal, as while compiling
        sys.stderr.write('virtual_stm32: interrupted\n')
        return INTERRUPTED
    if status not in {0, BAD_INPUT}:  # or it has said why
        sys.stderr.write(f'virtual_stm32: the firmware ended with status {status}\n')
        return 1
    return status


def board_of(args: argparse.Namespace) -> Board:
    """The firmware's process that the arguments ask for; it says where its port is."""
    if args.qemu:
        if args.key is not None:
            raise ConfigurationError('--key', 'the emulated STM32 keeps no key')
        emulated = EmulatedBoard(built_file(ELF), args.link)
        say(f'virtual STM32 on {emulated.path}\n')
        return emulated
    options: list[str | Path] = ['--key', args.key] if args.key is not None else []
    return Board.linux(*options, *(['--link', args.link] if args.link is not None else []))


def fly(aircraft: Aircraft, board: Board, args: argparse.Namespace, stop: Stop) -> None:
    """Fly until a signal, the duration or the firmware's own end."""
    with contextlib.suppress(EndedError):
        flight = Flight(aircraft, board, lockstep=args.lockstep is not None)
        if args.lockstep is not None:
            with contextlib.closing(Line(args.lockstep, say)) as line:
                fly_in_lockstep(flight, board, line, stop)
        while not stop:
            flight.cycle()


if __name__ == '__main__':
    sys.exit(main())
