"""Parameters of the `serial_bridge` node: names, ranges, units, and their frozen values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor

from quad_bridge.craft import Craft
from quad_bridge.errors import BadInputError
from quad_bridge.gains.gate import bound_from
from quad_bridge.gains.history import default_folder
from quad_bridge.gains.polarity import MODES
from quad_bridge.gains.table import DEFAULT_BOUNDS, SETTABLE, Bound
from quad_bridge.gains.update import GainSettings
from quad_bridge.key_file import MAKE, signing_from
from quad_bridge.link.port import over_network
from quad_bridge.link.udp import is_udp, parts
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.description import declared_craft
from quad_bridge.wire.signing import Signing


@dataclass(frozen=True)
class BridgeSettings:
    """Parameters with which the node was started."""

    port: str
    baud: int
    excitation_valid_ms: int
    signing: Signing | None
    require_enable: bool
    correct_sensors: bool
    craft: Craft | None
    gains: GainSettings
    logger: Mapping[str, Any] | None
    """Parameters of a logger in the bridge's process; None: there is none."""
    allow_gains: bool
    allow_excitation: bool
    fetch_log: bool

    @property
    def line_baud(self) -> int | None:
        """The rate of a serial line; None where the port is none."""
        return None if '://' in self.port else self.baud


OWN = (
    'port', 'baud', 'excitation_valid_ms', 'key_file', 'unsigned', 'require_enable', 'sources',
    'polarity', 'aircraft', 'state_folder', 'managed', 'correct_sensors', 'robot_description',
    'gains', 'excitation', 'fetch_log', 'log',
)  # fmt: skip
INSIDE, LOGGER = 'inside', 'bag_logger.'


def declare(node: Any) -> BridgeSettings:
    """Declare and read the parameters. Raises BadInputError naming the one that is wrong."""
    bounds = {f'bounds.{name}': name for name in SETTABLE}
    overrides = ros_node.overrides(node)
    logs_inside = overrides.get('log') == INSIDE
    loggers = [name for name in overrides if logs_inside and name.startswith(LOGGER)]
    ros_node.refuse_unknown(node, [*OWN, *bounds, *loggers])
    log = ros_node.declared(
        node, 'log', '', f'{INSIDE}: a logger in this process; its parameters are {LOGGER}NAME'
    )
    if log not in {'', INSIDE}:
        raise BadInputError('parameter log', f"must be '' or {INSIDE}", log)
    port = ros_node.declared(
        node, 'port', '/dev/ttyACM0',
        'device, pattern (/dev/ttyACM*), udp://HOST:PORT, udpin://, udpout:// or URL of pyserial',
    )
    _refuse_bad(port)
    return BridgeSettings(
        port=port,
        baud=ros_node.declared(node, 'baud', 921600, 'baud rate, bit/s', (9600, 12_000_000)),
        excitation_valid_ms=ros_node.declared(
            node, 'excitation_valid_ms', 100,
            'how long the STM32 keeps an excitation set-point that nothing replaces, ms',
            (8, 500),
        ),
        signing=_signing(node, port),
        require_enable=ros_node.declared(
            node, 'require_enable', over_network(port),
            'excite and arm only while /operator/enable is alive; default: over a network; '
            'on other links once somebody has held it',
        ),
        correct_sensors=ros_node.declared(
            node, 'correct_sensors', True,
            "subtract the gyro's bias at rest from /imu/data",
        ),
        craft=declared_craft(node),
        gains=_gains(node, bounds),
        allow_gains=_allowed(node, 'gains', 'gains'),
        allow_excitation=_allowed(node, 'excitation', 'excitation'),
        fetch_log=ros_node.declared(
            node, 'fetch_log', True,
            "fetch the log of PX4 or ArduPilot over the line after each landing",
        ),
        logger={n.removeprefix(LOGGER): overrides[n] for n in loggers} if logs_inside else None,
    )  # fmt: skip


def _refuse_bad(port: str) -> None:
    if not port:
        raise BadInputError('parameter port', 'must name a device', "''")
    if is_udp(port):
        try:
            parts(port)
        except ValueError as error:
            raise BadInputError('parameter port', str(error)) from error


def _signing(node: Any, port: str) -> Signing | None:
    key_file = ros_node.declared(
        node, 'key_file', '',
        'key for MAVLink 2 signing; required where port leads to another computer',
    )
    unsigned = ros_node.declared(
        node, 'unsigned', False,
        'true: whoever reaches the port over a network may speak, without a key',
    )
    if key_file and unsigned:
        raise BadInputError('parameter unsigned', 'must be false where key_file is set', 'true')
    if not key_file and not unsigned and over_network(port):
        what = f'is required where the port leads to another computer ({port})'
        remedy = f'{MAKE}; or set unsigned:=true where everybody on that network may command'
        raise BadInputError('parameter key_file', what, remedy=remedy)
    return signing_from(Path(key_file).expanduser() if key_file else None)


def _gains(node: Any, bounds: Mapping[str, str]) -> GainSettings:
    folder = ros_node.declared(
        node, 'state_folder', '', 'history of gains and checks; empty: quad_suite in ROS_HOME'
    )
    aircraft = ros_node.declared(
        node, 'aircraft', '', "name of its folder there; empty: the STM32's unique number"
    )
    if '/' in aircraft or aircraft.startswith('.'):
        raise BadInputError('parameter aircraft', 'must be a plain name', aircraft)
    sources = ros_node.declared(
        node, 'sources', ['*'], 'sources of /gains/update that are allowed, * for any'
    )
    return GainSettings(
        bounds={**DEFAULT_BOUNDS, **_bounds(node, bounds)},
        sources=tuple(pattern for pattern in sources if pattern),
        polarity=_choice(node, 'polarity', MODES,
                         f'pulses before the first update: {", ".join(MODES)}'),
        folder=Path(folder).expanduser() if folder else default_folder(),
        aircraft=aircraft,
    )


def _allowed(node: Any, name: str, what: str) -> bool:
    """A switch that is off unless it says `allow`."""
    return _choice(node, name, ('off', 'allow'), f'{what} on PX4 and ArduPilot: off, or allow, '
                   'which an operator sets who has read docs/px4.md or docs/ardupilot.md'
                   ) == 'allow'  # fmt: skip


def _choice(node: Any, name: str, choices: Sequence[str], text: str) -> str:
    """A parameter that is one of these, the first by default."""
    descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=True)
    value = node.declare_parameter(name, choices[0], descriptor).value
    value = 'off' if value is False else value  # as YAML takes a plain `off`
    if value not in choices:
        raise BadInputError(f'parameter {name}', f'must be one of {", ".join(choices)}',
                            repr(value))
    return str(value)


def _bounds(node: Any, known: Mapping[str, str]) -> dict[str, Bound]:
    """One optional list per gain: `bounds.<gain>: [lower, upper(, max_factor(, small_step))]`."""
    overrides = ros_node.overrides(node)
    bounds = {}
    for key, name in known.items():
        if key not in overrides:
            continue
        text = f'[lower, upper(, max_factor(, small_step))] of {name}, SI'
        descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=True)
        value = node.declare_parameter(key, overrides[key], descriptor).value
        try:
            numbers = [float(v) for v in value]
        except (TypeError, ValueError) as error:
            raise BadInputError(f'parameter {key}', 'must be a list of numbers', value) from error
        bounds[name] = bound_from(name, numbers)
    return bounds
