"""The first lines of every program's process, before its imports; nothing of ROS, no numpy here.

The imports take a second or more. An interrupt meanwhile ends the process at once, with the status
and the words of one that was interrupted later: nothing is open yet.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from pathlib import Path

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
INTERRUPTED = 130  # status of a command; a node runs until then by design and ends with 0


def begin(module: str) -> None:
    """Import `module` and run its `main`, which takes the signals over."""
    _guard(0)
    listen_by_udp()
    stay_on_this_computer()
    importlib.import_module(module).main()


def _guard(interrupted: int, words: str = '') -> None:
    """See the module; `interrupted` is the exit status."""
    _open_standard_streams()

    def end(*_: object) -> None:
        os.write(2, words.encode())
        os._exit(interrupted)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)


def listen_by_udp() -> None:
    """Keep Fast DDS, where it is the middleware, from shared memory, unless the user chose a way.

    A node that has no CPU for a second may never again hear what comes through shared memory, and
    one that is killed may take with it all that still talk to it (docs/log.md). The profile is
    for localhost alone, where rmw_fastrtps sets up its own transports; the variable for all else.
    """
    if not {PROFILES, 'FASTDDS_BUILTIN_TRANSPORTS'} & os.environ.keys():
        os.environ[PROFILES] = str(Path(__file__).with_name('fastdds.xml'))
        os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'


def stay_on_this_computer() -> None:
    """Let no other computer find the nodes, unless the user opened that: whoever does commands.

    `ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET` opens it, as ROS 2 has it by default.
    """
    os.environ.setdefault(RANGE, 'LOCALHOST')


def _open_standard_streams() -> None:
    """Give a process that was started without them (`2>&-`) streams that lead nowhere.

    Else the serial port or the bag gets number 2, and what ROS logs is written into it.
    """
    while True:
        number = os.open(os.devnull, os.O_RDWR)
        if number > 2:
            os.close(number)
            break
        os.set_inheritable(number, True)
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: PTH123, SIM115


def serial_bridge() -> None:
    """`ros2 run quad_bridge serial_bridge`; with `--check` no node, but a look at the aircraft."""
    if '--check' in sys.argv:
        sys.exit(_command('serial_bridge --check', 'quad_bridge.autopilots.check'))
    begin('quad_bridge.nodes.serial_bridge')


def bag_logger() -> None:
    """`ros2 run quad_bridge bag_logger`."""
    begin('quad_bridge.nodes.bag_logger')


def monitor() -> None:
    """`ros2 run quad_bridge monitor`."""
    begin('quad_bridge.nodes.monitor')


def virtual_stm32() -> int:
    """`ros2 run quad_bridge virtual_stm32`: no node, but it ends as they do."""
    _guard(INTERRUPTED)
    process = importlib.import_module('quad_bridge.virtual.process')
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    return int(process.main())


def recover() -> int:
    """`ros2 run quad_bridge recover`."""
    return _command('recover', 'quad_bridge.log.recover')


def sensors() -> int:
    """`ros2 run quad_bridge sensors`."""
    return _command('sensors', 'quad_bridge.sensors.command')


def setup() -> int:
    """`ros2 run quad_bridge setup`."""
    return _command('setup', 'quad_bridge.setup.wizard')


def make_key() -> int:
    """`ros2 run quad_bridge make_key`."""
    return _command('make_key', 'quad_bridge.key_file')


def _command(name: str, module: str) -> int:
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    words = f'{name}: interrupted\n'
    _guard(INTERRUPTED, words)
    main = importlib.import_module(module).main
    for number, handler in handlers.items():
        signal.signal(number, handler)
    try:
        return int(main() or 0)
    except KeyboardInterrupt:
        sys.stderr.write(words)
        return INTERRUPTED
