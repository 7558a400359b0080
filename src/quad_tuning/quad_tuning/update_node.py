"""The node of `quad-tune send` and `rollback`: a set of gains to the bridge, and its answer."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Mapping
from typing import Any

import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.exceptions import InvalidNamespaceException
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from quad_bridge.lockstep import patience
from quad_bridge.nodes.conversion import event_message
from quad_bridge.start import listen_by_udp, stay_on_this_computer
from quad_sysid.errors import BadInputError

LISTEN_S, ANSWER_S = 10.0, 150.0
"""Until a bridge is heard, and until its gate answers: it watches one step after the other."""
GONE_S = 2.0
"""Without the bridge's service for this long it has ended."""
SERVICE = 'serial_bridge/set_gains'
GOES_ON = 'the bridge goes on with these gains; quad-tune rollback takes them back'


def publish(gains: Mapping[str, float], source: str, *, rollback: bool = False,
            beside: Mapping[str, str] | None = None, namespace: str = '',
            aircraft: str = '') -> tuple[bool, str]:
    """Send `gains` (contract names, SI) to the bridge; `rollback`: or revert those in flight.

    `beside` is what a design sends with its gains, `namespace` the bridge's, `aircraft` the name
    of the one they are for, if that is known. Returns whether the aircraft has read them back, and
    why not; on the ground of several steps the first, as the words say. Raises BadInputError for
    an invalid namespace or a bridge that is not there or does not answer, KeyboardInterrupt on
    SIGINT, with words for the user where the bridge has the gains by then. Call it in the main
    thread.
    """
    try:
        validate_namespace(f'/{namespace.strip("/")}')
    except InvalidNamespaceException as error:
        raise BadInputError('--namespace', 'is not a valid ROS namespace', namespace) from error
    interrupted = threading.Event()
    lines: list[str] = []  # to the user who interrupts
    with contextlib.ExitStack() as ending:
        # an exception that a signal raises within rclpy may be swallowed there
        before = signal.signal(signal.SIGINT, lambda *_: interrupted.set())
        ending.callback(signal.signal, signal.SIGINT, before)
        listen_by_udp()
        stay_on_this_computer()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        ending.callback(rclpy.try_shutdown)
        node: Any = rclpy.create_node('quad_tune', namespace=namespace)
        ending.callback(node.destroy_node)
        executor = SingleThreadedExecutor()
        ending.callback(executor.shutdown)
        executor.add_node(node)
        client = node.create_client(SetParametersAtomically, SERVICE)

        def spin(until: Any, seconds: float) -> bool:
            end = time.monotonic() + patience(seconds)
            while not until() and time.monotonic() < end:
                executor.spin_once(timeout_sec=0.1)
                if interrupted.is_set():
                    raise KeyboardInterrupt(*lines)
            return bool(until())

        if not spin(client.service_is_ready, LISTEN_S):
            raise BadInputError(client.srv_name, f'no bridge has answered for {LISTEN_S:.0f} s',
                                remedy='start serial_bridge, or give its --namespace')
        values: dict[str, bool | float | str] = {**gains, 'source': source,
                                                 **(beside or {}),
                                                 **({'aircraft': aircraft} if aircraft else {}),
                                                 **({'rollback': True} if rollback else {})}
        parameters = event_message(values, '/quad_tune', 0).changed_parameters
        lines.append(GOES_ON)
        answer = client.call_async(SetParametersAtomically.Request(parameters=parameters))
        there_s = time.monotonic()  # when the bridge was last there

        def ended() -> bool:
            nonlocal there_s
            if client.service_is_ready():
                there_s = time.monotonic()
            return answer.done() or time.monotonic() - there_s > GONE_S

        if not spin(ended, ANSWER_S):
            raise BadInputError(client.srv_name,
                                f'no answer of the bridge for {ANSWER_S:.0f} s')
        if not answer.done():
            raise BadInputError(client.srv_name, 'the bridge has ended before it answered',
                                remedy='start it again and read /gains/active before you go on')
        result = answer.result().result
        unsaid = '' if result.successful else 'the bridge gives no reason'
        return result.successful, result.reason or unsaid
