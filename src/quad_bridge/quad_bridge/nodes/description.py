"""The parameter and topic `robot_description`: the craft as a URDF. Wiring only.

What is published here, or given, says where the motors are (craft.py). A description without
joints `motor_i`, as robot_state_publisher gives it for a model that is drawn, is left aside.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from std_msgs.msg import String

from quad_bridge.craft import LAYOUTS, Craft, from_urdf
from quad_bridge.errors import BadInputError
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.qos import HEARD, STATE
from quad_bridge.one_line import shortened

TOPIC, PARAMETER = '/robot_description', 'robot_description'
WITHOUT_MOTORS = f'{TOPIC} has no joint motor_1: left aside, as a model that is drawn'


def declared_craft(node: Any) -> Craft | None:
    """The craft by the parameter `robot_description`, None where it is not set.

    Raises BadInputError where it is none.
    """
    value = ros_node.declared(
        node, PARAMETER, '',
        "the craft: a URDF with joints motor_i, a file with one, or a layout's name",
    )  # fmt: skip
    return craft_of(value.strip()) if value.strip() else None


def craft_of(value: str) -> Craft:
    """The craft of a URDF's text, of a file with one, or of a layout's name."""
    where = f'parameter {PARAMETER}'
    if value in LAYOUTS:
        return LAYOUTS[value]
    text = value
    if not value.startswith('<'):
        where = f'{where} ({value})'
        try:
            text = Path(value).expanduser().read_text(encoding='utf-8')
        except (OSError, UnicodeDecodeError, ValueError) as error:
            layouts = f'layouts are {", ".join(LAYOUTS)}'
            what = 'is neither a layout, nor a URDF, nor a file that can be read'
            raise BadInputError(where, what, remedy=layouts) from error
    try:
        craft = from_urdf(text)
    except ValueError as error:
        raise BadInputError(where, str(error), shortened(text)) from error
    if craft is None:
        remedy = 'give each motor a continuous joint motor_1, motor_2 …'
        raise BadInputError(where, 'has no joint motor_1', remedy=remedy)
    return craft


MAX_BYTES = 1_000_000  # largest description, and so the largest message of the contract
MAX_TEXTS = 20
"""Different descriptions that are looked at: more than that is a flood."""


def why_ignored(text: str) -> str:
    """Why a description says nothing of the motors; empty where it does."""
    try:
        return '' if from_urdf(text) is not None else WITHOUT_MOTORS
    except ValueError as error:
        return f'{TOPIC} {error}: left aside'


class Description:
    """Publishes this craft's description, and hears those of others."""

    def __init__(self, node: Any, own: Craft | None, on_craft: Callable[[Craft], None]) -> None:
        """`on_craft` is called with a craft that somebody else describes."""
        self._node, self._own, self._on_craft = node, own, on_craft
        self._published: Craft | None = None
        self._texts: set[str] = set()  # what has been published here, or judged
        self._publisher: Any = None

    @property
    def craft(self) -> Craft | None:
        """The craft of the parameter, or that of another node."""
        return self._own or self._published

    def configure(self) -> None:
        """Create the publisher."""
        self._texts.clear()
        self._publisher = self._node.publisher(String, TOPIC, STATE)

    def activate(self) -> None:
        """Listen to others."""
        self._node.subscribe(String, TOPIC, self._take, HEARD, MAX_BYTES)

    def publish(self, craft: Craft) -> None:
        """Describe this craft, unless somebody else has."""
        text = craft.to_urdf()
        if craft is not self._published and text not in self._texts:
            self._texts.add(text)
            self._publisher.publish(String(data=text))

    def _take(self, message: String) -> None:
        if message.data in self._texts or len(self._texts) >= MAX_TEXTS:
            return
        self._texts.add(message.data)
        words = why_ignored(message.data)
        if not words and self._own is not None:
            words = f'{TOPIC} of another node differs from the parameter, which holds'
        if words:
            self._node.get_logger().warning(words)
            return
        self._published = from_urdf(message.data)
        if self._published is not None:
            self._on_craft(self._published)
