"""Parameters of the `serial_bridge` node: names, ranges, units, and their frozen values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor

from quad_bridge import ros_node
from quad_bridge.aircraft_store import default_folder
from quad_bridge.errors import BadInputError
from quad_bridge.gain_gate import DEFAULT_BOUNDS, Bound, bound_from
from quad_bridge.gain_state import KeeperSettings
from quad_bridge.polarity_check import MODES
from quad_bridge.wire.gain_names import READ_ONLY, WIRE_NAMES


@dataclass(frozen=True)
class BridgeSettings:
    """What the node was started with."""

    port: str
    baud: int
    excitation_valid_ms: int
    keeper: KeeperSettings


OWN = (
    'port', 'baud', 'excitation_valid_ms', 'sources', 'polarity', 'aircraft', 'state_folder',
)  # fmt: skip


def declare(node: Any) -> BridgeSettings:
    """Declare and read the parameters. Raises BadInputError naming the one that is wrong."""
    bounds = {f'bounds.{name}': name for name in WIRE_NAMES if name not in READ_ONLY}
    ros_node.refuse_unknown(node, [*OWN, *bounds])
    settings = BridgeSettings(
        port=ros_node.text(node, 'port', '/dev/ttyACM0', 'serial device, or a URL of pyserial'),
        baud=ros_node.integer(node, 'baud', 921600, (9600, 12_000_000), 'baud rate, bit/s'),
        excitation_valid_ms=ros_node.integer(
            node,
            'excitation_valid_ms',
            100,
            (8, 1000),
            'how long the STM32 keeps an excitation set-point that nothing replaces, ms',
        ),
        keeper=_keeper(node, bounds),
    )
    if not settings.port:
        raise BadInputError('serial_bridge: parameter port', 'must name a device', "''")
    return settings


def _keeper(node: Any, bounds: Mapping[str, str]) -> KeeperSettings:
    folder = ros_node.text(
        node, 'state_folder', '', 'history of gains and checks; empty: quad_suite in ROS_HOME'
    )
    aircraft = ros_node.text(
        node, 'aircraft', '', "name of its folder there; empty: the STM32's unique number"
    )
    if '/' in aircraft or aircraft.startswith('.'):
        raise BadInputError('serial_bridge: parameter aircraft', 'must be a plain name', aircraft)
    return KeeperSettings(
        bounds={**DEFAULT_BOUNDS, **_bounds(node, bounds)},
        sources=_sources(node),
        polarity=ros_node.choice(node, 'polarity', MODES, 'pulses before the first update'),
        folder=Path(folder).expanduser() if folder else default_folder(),
        aircraft=aircraft,
    )


def _sources(node: Any) -> tuple[str, ...]:
    """Patterns (`*`, `identification*`) of the sources that may change gains."""
    descriptor = ParameterDescriptor(
        description='sources of /gains/update that are allowed, * for any', read_only=True
    )
    given = node.declare_parameter('sources', ['*'], descriptor).value
    return tuple(str(pattern) for pattern in given if pattern)


def _bounds(node: Any, known: Mapping[str, str]) -> dict[str, Bound]:
    """One optional list per gain: `bounds.<gain>: [lower, upper(, max_factor(, small_step))]`."""
    given = ros_node.overrides(node)
    bounds = {}
    for key, name in known.items():
        if key not in given:
            continue
        descriptor = ParameterDescriptor(
            description=f'[lower, upper(, max_factor(, small_step))] of {name}, SI',
            read_only=True,
            dynamic_typing=True,
        )
        value = node.declare_parameter(key, given[key], descriptor).value
        try:
            numbers = [float(v) for v in value]
        except (TypeError, ValueError) as error:
            raise BadInputError(f'parameter {key}', 'must be a list of numbers', value) from error
        bounds[name] = bound_from(name, numbers)
    return bounds
