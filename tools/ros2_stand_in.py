#!/usr/bin/env python
"""`ros2 run` and `ros2 service call` for a shell of `make shell` where ROS 2 itself is missing.

The rclpy wheels bring no `ros2` command. Nothing else of it is imitated here: launch files, `ros2
topic` and the like need ROS 2.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

USAGE = (
    'ros2: without ROS 2 installed there is only: ros2 run PACKAGE EXECUTABLE [ARGS …] and '
    'ros2 service call NAME TYPE [YAML]; start each node of a launch file by ros2 run'
)
PATIENCE_S = 60.0


def run(package: str, executable: str, arguments: list[str]) -> str:
    """Become the executable, as `ros2 run` starts it; returns what is wrong."""
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    folders = [prefix / 'lib' / package for prefix in prefixes]
    for folder in folders:
        path = folder / executable
        if path.is_file() and os.access(path, os.X_OK):
            os.execv(path, [str(path), *arguments])  # noqa: S606  (signals reach the node itself)
    there = (path for folder in folders if folder.is_dir() for path in folder.iterdir())
    known = sorted({path.name for path in there})
    if not known:
        return f'ros2 run: package {package}: is not built; run make build'
    return f'ros2 run: {package} has no {executable}; it has {", ".join(known)}'


def fill(message: Any, values: object) -> None:
    """Set the fields of a message; one that is unknown or of another type raises."""
    kind = type(message).__name__.partition('_')[2] or type(message).__name__
    if not isinstance(values, Mapping):
        raise TypeError(f'a {kind} is {{field: value, …}}, not {values!r}')
    known = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
    for field, value in values.items():
        if field not in known:
            there = ', '.join(known) or 'no fields'
            raise ValueError(f'the {kind} has no {field}; it has {there}')
        setattr(message, field, converted(value, known[field]))


def converted(value: object, kind: Any) -> object:
    """A value read from YAML as a field's type takes it: messages, lists of them, floats."""
    from rosidl_parser.definition import AbstractNestedType, BasicType, NamespacedType

    if isinstance(kind, AbstractNestedType) and isinstance(value, list):
        return [converted(one, kind.value_type) for one in value]
    if isinstance(kind, NamespacedType):
        message = getattr(importlib.import_module('.'.join(kind.namespaces)), kind.name)
        made = message(check_fields=True)
        fill(made, value)
        return made
    if isinstance(kind, BasicType) and kind.typename in ('float', 'double') and type(value) is int:
        return float(value)
    return value


def call(name: str, kind: str, text: str) -> str:
    """Call a service once and write its answer; returns what is wrong."""
    import rclpy
    import yaml

    package, _, service = kind.partition('/srv/')
    try:
        offered = getattr(importlib.import_module(f'{package}.srv'), service)
    except (ImportError, AttributeError, ValueError):
        return f'ros2 service call: {kind} is no service type, such as std_srvs/srv/Trigger'
    request = offered.Request(check_fields=True)
    try:
        fill(request, yaml.safe_load(text) or {})
    except (AssertionError, TypeError, ValueError, yaml.YAMLError) as error:
        return f'ros2 service call: {" ".join(f"{text}: {error}".split())}'
    rclpy.init()
    try:
        return asked(rclpy.create_node('service_call'), name, kind, offered, request)
    except KeyboardInterrupt:
        return 'ros2 service call: interrupted'
    finally:
        rclpy.try_shutdown()


def asked(node: Any, name: str, kind: str, offered: Any, request: Any) -> str:
    """Wait for a service, call it and write its answer; returns what is wrong."""
    import rclpy

    client = node.create_client(offered, name)
    begun_s, said = time.monotonic(), False
    while not client.wait_for_service(1.0):  # a node takes its time to start
        full = node.resolve_service_name(name)
        kinds = dict(node.get_service_names_and_types()).get(full, [])
        others = ', '.join(one for one in kinds if one != kind)  # the client's own is there
        if others:
            return f'ros2 service call: {name} is a {others}'
        if time.monotonic() - begun_s > PATIENCE_S:
            return f'ros2 service call: nobody offers {name} within {PATIENCE_S:g} s'
        if not said:
            said = True
            sys.stderr.write(f'waiting for {name}, {PATIENCE_S:g} s at most\n')
    answer = client.call_async(request)
    rclpy.spin_until_future_complete(node, answer, timeout_sec=PATIENCE_S)
    if not answer.done():
        return f'ros2 service call: {name} gave no answer'
    sys.stdout.write(f'response:\n{answer.result()!r}\n')
    return ''


def main(words: list[str]) -> int:
    """Exit status: that of what was started, or 2 with one line on stderr."""
    if len(words) >= 3 and words[0] == 'run':
        wrong = run(words[1], words[2], words[3:])
    elif len(words) in (4, 5) and words[:2] == ['service', 'call']:
        wrong = call(words[2], words[3], words[4] if len(words) == 5 else '')
    else:
        wrong = USAGE
    if wrong:
        sys.stderr.write(f'{wrong}\n')
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
