"""`quad-tune send` to the bridge of one namespace; another aircraft's must not hear it."""

import threading

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter, ParameterEvent
from rclpy.executors import SingleThreadedExecutor

from quad_sysid.errors import BadInputError
from quad_tuning.history.update_node import STATE, publish

GAINS = {'roll.rate.kp': 0.08}


class Bridge:
    """Stands in for a bridge: says what is active, takes every update."""

    def __init__(self, namespace, context):
        self.node = rclpy.create_node('serial_bridge', namespace=namespace, context=context)
        self.asked = []
        self.active = self.node.create_publisher(ParameterEvent, 'gains/active', STATE)
        self.diagnostics = self.node.create_publisher(DiagnosticArray, 'diagnostics', 10)
        self.node.create_subscription(ParameterEvent, 'gains/update', self.take, 10)
        self.node.create_timer(0.05, self.report)
        self.active.publish(ParameterEvent(changed_parameters=[Parameter(name='yaw.rate.kp')]))

    def take(self, event):
        self.asked.append({p.name: p.value.double_value for p in event.changed_parameters})
        self.active.publish(event)

    def report(self):
        status = DiagnosticStatus(name='serial_bridge: gains', message='read back')
        self.diagnostics.publish(DiagnosticArray(status=[status]))


@pytest.fixture
def bridges(ros_domain):
    context = rclpy.Context()
    context.init(domain_id=ros_domain)
    executor = SingleThreadedExecutor(context=context)
    both = [Bridge(name, context) for name in ('left', 'right')]
    for bridge in both:
        executor.add_node(bridge.node)
    done = threading.Event()

    def spin():
        while not done.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    yield both
    done.set()
    thread.join()
    executor.shutdown()
    context.try_shutdown()


def test_gains_reach_the_bridge_of_their_namespace_only(bridges):
    left, right = bridges
    assert publish(GAINS, 'test', namespace='/left') == ''
    (asked,) = left.asked
    assert asked['roll.rate.kp'] == GAINS['roll.rate.kp']
    assert right.asked == []


def test_a_namespace_that_is_none_is_refused_in_one_line(bridges):
    with pytest.raises(BadInputError, match='--namespace: is no name of a namespace: found my'):
        publish(GAINS, 'test', namespace='my quad')
    assert [bridge.asked for bridge in bridges] == [[], []]
