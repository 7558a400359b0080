"""The logger as a node under load: messages published, messages in the bag, CPU of the process."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from rosbags.highlevel import AnyReader

START = 'from quad_bridge.nodes.bag_logger import main; main()'
TYPES = {
    '/imu/data': 'sensor_msgs.msg.Imu',
    '/motors/command': 'sensor_msgs.msg.JointState',
    '/control/wrench': 'geometry_msgs.msg.WrenchStamped',
    '/setpoint/attitude': 'geometry_msgs.msg.Vector3Stamped',
    '/setpoint/rates': 'geometry_msgs.msg.Vector3Stamped',
    '/excitation/setpoint': 'geometry_msgs.msg.Vector3Stamped',
    '/excitation/applied': 'geometry_msgs.msg.Vector3Stamped',
    '/imu/mag': 'sensor_msgs.msg.MagneticField',
}
RATES = (1500, 4000, 16_000)
TICK_HZ = os.sysconf('SC_CLK_TCK')


def cpu_s(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICK_HZ


class Load:
    """Publishes serialised messages, so that the load costs little beside the logger."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.qos import QoSProfile
        from rclpy.serialization import serialize_message

        rclpy.init()
        self.node = rclpy.create_node('load')
        self.publishers = []
        for topic, kind in TYPES.items():
            module, name = kind.rsplit('.', 1)
            message = getattr(importlib.import_module(module), name)()
            message.header.frame_id = 'base_link'
            if name == 'JointState':
                message.name = [f'motor_{i}' for i in range(1, 5)]
                message.effort = [0.5] * 4
            publisher = self.node.create_publisher(type(message), topic, QoSProfile(depth=100))
            self.publishers.append((publisher, serialize_message(message)))

    def run(self, rate: float, seconds: float) -> int:
        while any(p.get_subscription_count() < 1 for p, _ in self.publishers):
            time.sleep(0.05)
        time.sleep(0.5)
        begin_s, rounds = time.monotonic(), 0
        while (passed := time.monotonic() - begin_s) < seconds:
            while rounds < passed * rate / len(TYPES):
                for publisher, data in self.publishers:
                    publisher.publish(data)
                rounds += 1
            time.sleep(0.001)
        return rounds * len(TYPES)


def study(folder: Path, seconds: float) -> list[dict[str, float | str]]:
    """Print the table of rates; nothing where there is no rclpy."""
    try:
        load = Load()
    except ImportError:
        print('no rclpy: the node is left out')
        return []
    print('Logger node  messages/s  published  in the bag   lost  CPU %')
    out: list[dict[str, float | str]] = []
    for rate in RATES:
        place = folder / f'{rate}'
        settings = {'folder': place, 'autostart': 'true'}
        arguments = [a for k, v in settings.items() for a in ('-p', f'{k}:={v}')]
        node = subprocess.Popen(
            [sys.executable, '-c', START, '--ros-args', *arguments], stderr=subprocess.DEVNULL
        )
        time.sleep(1.5)
        before, began_s = cpu_s(node.pid), time.monotonic()
        published = load.run(rate, seconds)
        cpu = 100 * (cpu_s(node.pid) - before) / (time.monotonic() - began_s)
        time.sleep(0.5)
        node.send_signal(signal.SIGINT)
        node.wait()
        with AnyReader([next(place.glob('flight_*'))]) as reader:
            found = sum(c.msgcount for c in reader.connections if c.topic in TYPES)
        lost = published - found
        print(f'{rate:23d} {published:10d} {found:11d} {lost:6d} {cpu:6.1f}')
        out.append({'rate': rate, 'published': published, 'lost': lost, 'cpu_percent': cpu})
    return out
