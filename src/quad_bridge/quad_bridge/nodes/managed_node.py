"""A lifecycle node (configure, activate) that starts by itself unless a manager is to do it.

Nodes say what to do in `configure`, `activate`, `deactivate` and `cleanup`; the states and their
services are rclpy's. No topics here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.serialization import deserialize_message

from quad_bridge.errors import QuadBridgeError, RefusedError
from quad_bridge.lockstep import STREAMS, clock
from quad_bridge.nodes import ros_node
from quad_bridge.nodes.fence import Fence
from quad_bridge.nodes.node_time import TimedNode
from quad_bridge.status import WARN, Status

MAX_BYTES = 65_536  # largest message: all gains at once are a tenth of that


class Aside(ReentrantCallbackGroup):  # type: ignore[misc]
    """Subscriptions that the executor leaves alone; `waiting` takes their messages.

    To be woken for a message costs an executor many times what it costs to take one.
    """

    def can_execute(self, entity: Any) -> bool:
        """Never."""
        del entity
        return False


def waiting(subscription: Any, most: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Waiting messages of a subscription, at most so many, each with its information."""
    handle = subscription.handle
    with handle:
        for _ in range(most):
            message = handle.take_message(subscription.msg_type, subscription.raw)
            if message is None:
                return
            yield message


class ManagedNode(TimedNode, LifecycleNode):  # type: ignore[misc]
    """`begin` makes it active at once, unless the parameter `managed` is true."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        overrides = options.get('parameter_overrides', ())
        self.own_overrides = {override.name: override.value for override in overrides}
        self.keep_time()
        self.active = False
        self.refused_large = 0  # messages that were too large to be looked at
        self.fence = Fence(self.get_logger().error)  # what notes callbacks that fail
        self._managed = ros_node.declared(
            self, 'managed', False, 'wait for a lifecycle manager to configure and activate'
        )
        self._fault: Exception | None = None
        self._entities: list[tuple[Callable[[Any], object], Any]] = []  # destroyer, entity
        self._configured = 0  # so many of them `configure` has created

    def begin(self) -> None:
        """Go to the first state. Raises QuadBridgeError where that fails."""
        if self._managed:
            return
        self.trigger_configure()
        if self._fault is None:
            self.trigger_activate()
        if self._fault is not None:
            raise self._fault

    # What `configure` creates lives until `cleanup`, what `activate` creates until `deactivate`.

    def publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        """Create a publisher; `topic` relative to the namespace."""
        publisher = self.create_publisher(kind, relative(topic), qos)
        return self._keep(publisher, self.destroy_publisher)

    def stream(self, kind: Any, topic: str, qos: Any) -> Callable[[bytes], None]:
        """Create a publisher of serialised messages; what publishes one."""
        made = self.publisher(kind, topic, qos)
        if clock().simulated and topic in STREAMS:  # it reports what it publishes
            return made.publish  # type: ignore[no-any-return]
        handle = made.handle

        def publish(data: bytes) -> None:
            with handle:  # as rclpy's own, which looks at the type of each message besides
                handle.publish_raw(data)

        return publish

    def service(
        self, kind: Any, name: str, callback: Callable[..., Any], group: Any = None
    ) -> None:
        """Create a service, which answers though its callback fails."""
        callback = ros_node.answering(callback, self.fence)
        service = self.create_service(kind, name, callback, callback_group=group)
        self._keep(service, self.destroy_service)

    def timer(self, period_s: float, callback: Callable[[], None]) -> None:
        """Create a timer."""
        self._keep(self.create_timer(period_s, callback), self.destroy_timer)

    def subscribe(
        self, kind: Any, topic: str, callback: Callable[[Any], None], qos: Any,
        most_bytes: int = MAX_BYTES,
    ) -> None:  # fmt: skip
        """Create a subscription; what is larger is never unpacked."""

        def take(data: bytes) -> None:
            if len(data) <= most_bytes:
                callback(deserialize_message(data, kind))
                return
            self.refused_large += 1
            self.get_logger().warning(
                f'{topic}: a message of {len(data)} bytes was refused, at most {most_bytes} are '
                'taken', throttle_duration_sec=5.0,
            )  # fmt: skip

        subscription = self.create_subscription(kind, relative(topic), take, qos, raw=True)
        self._keep(subscription, self.destroy_subscription)

    def _keep(self, entity: Any, destroy: Callable[[Any], object]) -> Any:
        self._entities.append((destroy, entity))
        ros_node.poll_rarely(entity)
        return entity

    def _destroy(self, first: int) -> None:
        """Destroy all entities from the one of this number on, the last one first."""
        while len(self._entities) > first:
            destroy, entity = self._entities.pop()
            destroy(entity)

    def bounds(self) -> list[Status]:
        """The entry for /diagnostics of messages that were too large; empty without any."""
        if not self.refused_large:
            return []
        words = f'{self.refused_large} messages were refused because they are too large'
        return [Status('bounds', WARN, words, {'refused, too large': self.refused_large})]

    def refuse_unless_active(self) -> None:
        """Raise RefusedError where the node is not active."""
        if not self.active:
            raise RefusedError('the node is not active')

    def configure(self) -> None:
        """Create what is published and the services. Raises QuadBridgeError."""

    def activate(self) -> None:
        """Begin to work: subscriptions, timers. Raises QuadBridgeError."""

    def deactivate(self) -> None:
        """Cease to work; called before an active node ends too."""

    def close(self) -> None:
        """End: what runs is stopped."""
        if self.active:
            self.active = False
            self.deactivate()

    # rclpy's transitions.

    def on_configure(self, _state: Any) -> Any:
        """Configure."""
        answer = self._try(self.configure)
        self._configured = len(self._entities)
        if self._fault is not None:
            self._destroy(0)
        return answer

    def on_activate(self, _state: Any) -> Any:
        """Activate."""
        answer = self._try(self.activate)
        self.active = self._fault is None
        if not self.active:
            self._destroy(self._configured)
        return answer

    def on_deactivate(self, _state: Any) -> Any:
        """Deactivate."""
        self.active = False
        answer = self._try(self.deactivate)
        self._destroy(self._configured)
        return answer

    def on_cleanup(self, _state: Any) -> Any:
        """Destroy what `configure` has created."""
        self._destroy(0)
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Any) -> Any:
        """End."""
        self.close()
        return self.on_cleanup(state)

    def on_error(self, state: Any) -> Any:
        """Begin anew, unconfigured, after a transition that raised."""
        return self.on_cleanup(state)

    def _try(self, step: Callable[[], None]) -> Any:
        self._fault = None
        try:
            step()
        except QuadBridgeError as error:
            self._fault = error
            if self._managed:
                self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._fault = error  # rclpy says nothing of it
            raise
        return TransitionCallbackReturn.SUCCESS


def answered(response: Any, success: bool, message: str) -> Any:
    """A service's response, filled in."""
    response.success, response.message = success, message
    return response


def relative(topic: str) -> str:
    """A topic of the contract in the node's own namespace: two aircraft on one machine."""
    return topic.lstrip('/')
