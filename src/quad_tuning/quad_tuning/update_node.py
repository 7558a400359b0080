"""The node of `quad-tune send` and `rollback`: an update to the bridge, and its answer."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rclpy.exceptions import InvalidNamespaceException
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.lockstep import patience
from quad_bridge.nodes.conversion import event_message
from quad_bridge.nodes.qos import EVENT
from quad_bridge.start import listen_by_udp
from quad_sysid.errors import BadInputError
from quad_tuning.history import changed

LISTEN_S, ANSWER_S = 10.0, 60.0
FAILED = ('rolled back', 'not taken over')
"""Outcomes of updates that began but did not become active."""
DONE = ('writes acknowledged', 'rolled back')
"""The bridge's counts of what the STM32 has done."""
GAINS = 'serial_bridge: gains'


def publish(gains: Mapping[str, float], source: str, *, rollback: bool = False,
            predicted: str = '', namespace: str = '', aircraft: str = '') -> str:
    """Send `gains` (contract names, SI) to the bridge; `rollback`: or revert those in flight.

    `predicted` is JSON for /gains/update, `namespace` the bridge's, `aircraft` the name of the one
    they are for, if that is known. Returns '' once they are
    active, else the reason. Raises BadInputError for an invalid namespace or a bridge that does
    not listen or answer, KeyboardInterrupt on SIGINT. Call it in the main thread.
    """
    try:
        validate_namespace(f'/{namespace.strip("/")}')
    except InvalidNamespaceException as error:
        raise BadInputError('--namespace', 'is not a valid ROS namespace', namespace) from error
    interrupted = threading.Event()
    with contextlib.ExitStack() as ending:
        # an exception that a signal raises within rclpy may be swallowed there
        before = signal.signal(signal.SIGINT, lambda *_: interrupted.set())
        ending.callback(signal.signal, signal.SIGINT, before)
        listen_by_udp()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        ending.callback(rclpy.try_shutdown)
        node: Any = rclpy.create_node('quad_tune', namespace=namespace)
        ending.callback(node.destroy_node)
        executor = SingleThreadedExecutor()
        ending.callback(executor.shutdown)
        executor.add_node(node)
        heard = _Heard(source, () if rollback else FAILED)
        node.create_subscription(DiagnosticArray, 'diagnostics', heard.diagnostics, EVENT)
        publisher = node.create_publisher(ParameterEvent, 'gains/update', EVENT)

        def spin(until: Any, seconds: float) -> bool:
            end = time.monotonic() + patience(seconds)
            while not until() and time.monotonic() < end:
                executor.spin_once(timeout_sec=0.1)
                if interrupted.is_set():
                    raise KeyboardInterrupt
            return bool(until())

        def ready() -> bool:
            return bool(publisher.get_subscription_count() and heard.gains)

        asked, answered = (node.resolve_topic_name(t) for t in ('gains/update', 'diagnostics'))
        if not spin(ready, LISTEN_S):
            raise BadInputError(asked, f'no bridge has been heard for {LISTEN_S:.0f} s',
                                remedy='start serial_bridge, or give its --namespace')
        heard.before, done = heard.told, heard.done
        told: dict[str, bool | float | str] = {**gains, 'source': source,
                                               **({'predicted': predicted} if predicted else {}),
                                               **({'aircraft': aircraft} if aircraft else {}),
                                               **({'rollback': True} if rollback else {})}
        publisher.publish(event_message(told, '/quad_tune', 0))
        # the gains alone say nothing: they may have been the same before, and the link be down
        if not spin(lambda: heard.refusal or (heard.done > done
                                              and not changed(heard.gains, gains)), ANSWER_S):
            raise BadInputError(answered, f'no answer of the bridge for {ANSWER_S:.0f} s')
        return heard.refusal


class _Heard:
    """The bridge's last diagnostics, which hold its active gains, and those `before` the update.

    Not /gains/active: it is latched, and begins with the sets that were active earlier.
    """

    def __init__(self, source: str, failed: Sequence[str]) -> None:
        self._words = (f'gains of {source} refused', *failed)
        self.gains: dict[str, float] = {}
        self.message = ''
        self.told: tuple[str | None, ...] = ()
        """Message, and the counts that tell a refusal from an earlier one in the same words."""
        self.before: tuple[str | None, ...] = ()
        self.done = 0
        """Sets that the STM32 has taken or taken back since the bridge began."""

    @property
    def refusal(self) -> str:
        """Why the update failed; empty until a message says so."""
        new = self.before and self.told != self.before
        return self.message if new and any(w in self.message for w in self._words) else ''

    def diagnostics(self, array: Any) -> None:
        for status in array.status:
            if status.name == GAINS:
                values = {pair.key: pair.value for pair in status.values}
                self.message = status.message
                self.told = self.message, values.get('refused'), values.get('rolled back')
                self.done = sum(int(values.get(name, '0')) for name in DONE)
                self.gains = {name: float(values[name]) for name in WIRE_NAMES.keys() & values}
