"""The sensor watch as a process: a shaking /imu/data comes out as a line in /diagnostics."""

import math
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Imu

from quad_bridge.diagnostics import OK, WARN
from quad_bridge.qos import EVENT, STREAM
from quad_bridge.sensor_status import vibration_status
from quad_bridge.sensors.vibration import Vibration

START = 'from quad_bridge.sensor_watch_node import main; main()'
WAIT_S = 60.0


def test_a_line_that_the_filter_lets_through_is_a_warning():
    through = Vibration(33.0, 0.2, 0.8, 'x', 0.85)
    told = vibration_status('rates', 'rad/s', through)
    assert (told.level, told.message) == (
        WARN, '33.0 Hz on x, 0.2 rad/s; the filter does not cover it',
    )  # fmt: skip
    assert vibration_status('rates', 'rad/s', Vibration(110.0, 0.2, 0.8, 'x', 0.14)).level == OK
    assert 'no line' in vibration_status('r', '1', Vibration(33.0, 0.2, 0.1, 'x', 0.85)).message
    assert 'not enough' in vibration_status('r', '1', None).message


def test_a_vibration_is_told_live(ros_domain):
    process = subprocess.Popen([sys.executable, '-c', START])
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = rclpy.create_node('shaker', context=context)
    told = []
    node.create_subscription(DiagnosticArray, '/diagnostics', told.append, EVENT)
    publisher = node.create_publisher(Imu, '/imu/data', STREAM)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    message, k, found = Imu(), 0, []
    end_s = time.monotonic() + WAIT_S
    while not found and time.monotonic() < end_s:
        for _ in range(4):  # stamps, not the clock, say the rate
            message.header.stamp.sec, nanosec = divmod(k * 4_000_000, 10**9)
            message.header.stamp.nanosec = nanosec
            message.angular_velocity.y = 0.3 * math.sin(2 * math.pi * 40.0 * k * 0.004)
            publisher.publish(message)
            k += 1
        executor.spin_once(timeout_sec=0.016)
        found = [s for array in told for s in array.status if 'Hz on y' in s.message]
    process.send_signal(signal.SIGINT)
    status = process.wait(timeout=WAIT_S)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
    assert status == 0
    assert found[0].name == 'sensor_watch: vibration of the rates'
    assert found[0].message.startswith(('40.', '39.'))
    assert found[0].level == bytes([WARN])
