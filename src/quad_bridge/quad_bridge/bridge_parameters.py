"""Parameters of the `serial_bridge` node: names, ranges, units, and their frozen values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor

from quad_bridge import ros_node
from quad_bridge.errors import BadInputError
from quad_bridge.gain_gate import Bound, bound_from
from quad_bridge.wire.gain_names import READ_ONLY, WIRE_NAMES


@dataclass(frozen=True)
class BridgeSettings:
    """What the node was started with."""

    port: str
    baud: int
    excitation_valid_ms: int
    bounds: Mapping[str, Bound]
    """Contract name to bound; what is missing here cannot be changed."""


def declare(node: Any) -> BridgeSettings:
    """Declare and read the parameters. Raises BadInputError naming the one that is wrong."""
    bounds = {f'bounds.{name}': name for name in WIRE_NAMES if name not in READ_ONLY}
    ros_node.refuse_unknown(node, ['port', 'baud', 'excitation_valid_ms', *bounds])
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
        bounds=_bounds(node, bounds),
    )
    if not settings.port:
        raise BadInputError('serial_bridge: parameter port', 'must name a device', "''")
    return settings


def _bounds(node: Any, known: Mapping[str, str]) -> dict[str, Bound]:
    """One optional list per gain: `bounds.<gain>: [lower, upper(, max_factor)]`."""
    given = ros_node.overrides(node)
    bounds = {}
    for key, name in known.items():
        if key not in given:
            continue
        descriptor = ParameterDescriptor(
            description=f'[lower, upper] or [lower, upper, max_factor] of {name}, SI',
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
