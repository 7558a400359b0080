"""The processes of link_load.py that are not the suite's own: STM32, subscribers, bare publisher.

python bench/link_load_roles.py stm32|ears|raw|bare|exciter FOLDER [RATE]
"""

from __future__ import annotations

import json
import math
import signal
import struct
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from quad_bridge.start import listen_by_udp


class Stopped:
    def __init__(self) -> None:
        self.yes = False
        signal.signal(signal.SIGINT, self._stop)

    def _stop(self, *_: object) -> None:
        self.yes = True


def stm32(folder: Path, rate: float) -> None:
    """The virtual STM32, which notes when the last byte of each cycle was written."""
    from quad_bridge.virtual import process
    from quad_bridge.virtual.board import Board
    from quad_bridge.virtual.profile import load_profile

    profile = load_profile('plain')
    profile = replace(profile, mount='rig', firmware=replace(profile.firmware, rate_hz=rate))
    aircraft = process.prepared(profile, seed=1)
    board = Board.linux('--link', folder / 'tty')
    stop, written = process.Stop(aircraft, None), list[int]()
    flight = process.Flight(aircraft, board, lockstep=False)
    while not stop:
        flight.cycle()
        written.append(time.monotonic_ns())  # its frame has just gone to the port
    np.save(folder / 'wire.npy', np.array(written, np.int64))
    board.close()


def spin(node, stopped: Stopped) -> None:
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stopped.yes:
        executor.spin_once(timeout_sec=0.1)


def ears(folder: Path) -> None:
    """Subscribes to /imu/data as an analysis would, and notes stamp and time of each."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Imu

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopped, node = Stopped(), rclpy.create_node('ears')
    epoch_ns, heard = time.time_ns() - time.monotonic_ns(), []

    def take(message: Imu) -> None:
        stamp = message.header.stamp
        now_ns = time.monotonic_ns()
        heard.append((stamp.sec * 10**9 + stamp.nanosec - epoch_ns, now_ns))

    node.create_subscription(Imu, '/imu/data', take, qos_profile_sensor_data)
    spin(node, stopped)
    np.save(folder / 'ears.npy', np.array(heard, np.int64))


MODES = ('bytes', 'reused', 'anew')
"""How the bare publisher makes its messages, for a second each, one after the other: serialised
once for all, written into the same objects, or as new objects, as a node does that translates."""


def bare(folder: Path, rate: float) -> None:
    """Publishes the bridge's five messages on schedule; bare.json has µs of CPU per cycle."""
    import rclpy
    from geometry_msgs.msg import Vector3Stamped, WrenchStamped
    from rclpy.serialization import serialize_message
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Imu, JointState

    from quad_bridge.nodes.qos import STREAM

    def made() -> list:
        motors = JointState(name=[f'motor_{k}' for k in range(1, 5)], effort=[0.0] * 4)
        messages = [Imu(), motors, WrenchStamped(), Vector3Stamped(), Vector3Stamped()]
        for message in messages:
            message.header.frame_id = 'base_link'
        return messages

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopped, node = Stopped(), rclpy.create_node('bare')
    topics = ('/imu/data', '/motors/command', '/control/wrench', '/setpoint/attitude',
              '/setpoint/rates')  # fmt: skip
    reused, spent, cycles = made(), dict.fromkeys(MODES, 0.0), dict.fromkeys(MODES, 0)
    publishers = [node.create_publisher(type(message), topic, STREAM)
                  for message, topic in zip(reused, topics, strict=True)]  # fmt: skip
    raws = [bytearray(serialize_message(message)) for message in reused]
    begin_s, count, mode, cpu_s = time.monotonic(), 0, MODES[0], time.process_time()
    while not stopped.yes:
        time.sleep(max(0.0, begin_s + count / rate - time.monotonic()))
        before, mode = mode, MODES[int(count // rate) % 3]
        if mode != before:
            now_s = time.process_time()
            spent[before], cpu_s = spent[before] + now_s - cpu_s, now_s
        cycles[mode] += 1
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        messages = raws
        if mode != 'bytes':
            messages = reused if mode == 'reused' else made()
            fill(*messages, 1e-3 * count)
        for publisher, message in zip(publishers, messages, strict=True):
            if mode == 'bytes':
                struct.pack_into('<iI', message, 4, sec, nanosec)
                publisher.publish(bytes(message))
                continue
            message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
            publisher.publish(message)
        count += 1
    cycles[mode] -= int(count % rate)  # of the second that has not ended
    costs = {name: round(1e6 * spent[name] / max(cycles[name], 1), 1) for name in MODES}
    (folder / 'bare.json').write_text(json.dumps(costs))


def fill(imu, motors, wrench, attitude, rates, x: float) -> None:
    """Write a cycle's numbers into five messages."""
    q = imu.orientation
    q.x, q.y, q.z, q.w = x, x, x, x
    motors.effort = [x, x, x, x]
    wrench.wrench.force.z = x
    for v in (imu.angular_velocity, imu.linear_acceleration, wrench.wrench.torque,
              attitude.vector, rates.vector):  # fmt: skip
        v.x, v.y, v.z = x, x, x


def raw(folder: Path) -> None:
    """Subscribes to the five topics raw, and does nothing with them: the least a logger costs."""
    import rclpy
    from geometry_msgs.msg import Vector3Stamped, WrenchStamped
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Imu, JointState

    from quad_bridge.nodes.qos import STREAM

    kinds = {'/imu/data': Imu, '/motors/command': JointState, '/control/wrench': WrenchStamped,
             '/setpoint/attitude': Vector3Stamped, '/setpoint/rates': Vector3Stamped}
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopped, node, count = Stopped(), rclpy.create_node('raw'), [0]

    def take(_: bytes) -> None:
        count[0] += 1

    for topic, kind in kinds.items():
        node.create_subscription(kind, topic, take, STREAM, raw=True)
    spin(node, stopped)
    (folder / 'raw.count').write_text(str(count[0]))


def exciter(_: Path) -> None:
    """A running segment and 250 set-points a second."""
    import rclpy
    from geometry_msgs.msg import Vector3Stamped
    from rcl_interfaces.msg import ParameterEvent
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.signals import SignalHandlerOptions

    from quad_bridge.nodes.conversion import event_message
    from quad_bridge.nodes.qos import STATE

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopped, node = Stopped(), rclpy.create_node('exciter')
    segment = node.create_publisher(ParameterEvent, '/excitation/segment', STATE)
    setpoint = node.create_publisher(
        Vector3Stamped, '/excitation/setpoint', qos_profile_sensor_data
    )
    running = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'rate'}
    segment.publish(event_message(running, 'exciter', time.time_ns()))
    message, begin_s, count = Vector3Stamped(), time.monotonic(), 0
    while not stopped.yes:
        time.sleep(max(0.0, begin_s + count / 250.0 - time.monotonic()))
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
        message.vector.x = 0.1 * math.sin(0.1 * count)
        setpoint.publish(message)
        count += 1


def main() -> None:
    listen_by_udp()  # as the nodes do
    role, folder = sys.argv[1], Path(sys.argv[2])
    if role in {'stm32', 'bare'}:
        {'stm32': stm32, 'bare': bare}[role](folder, float(sys.argv[3]))
    else:
        {'ears': ears, 'raw': raw, 'exciter': exciter}[role](folder)


if __name__ == '__main__':
    main()
