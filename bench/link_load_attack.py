"""The attacker of link_load.py: it says whatever anybody in the domain and on the line can say.

python bench/link_load_attack.py FOLDER

A bag that is played, an enable of the past, forged bags, another MAVLink sender; every four
seconds a flood of parameters, a message of 5 MB, gains out of bounds and one call to disarm. None
of it may be obeyed; attack.json in the folder has what was answered. What a key or SROS2 keeps out
is not tried.
"""

from __future__ import annotations

import json
import math
import os
import struct
import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import Vector3Stamped
from link_load_roles import Stopped
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool

from quad_bridge.nodes.conversion import event_message, time_message
from quad_bridge.nodes.qos import EVENT, STATE, STREAM
from quad_bridge.start import listen_by_udp
from quad_bridge.wire.codec import Encoder
from quad_bridge.wire.frames import Heartbeat

OLD_NS = 10**18  # the time of a recording
CALM_S = 10.0  # before the attack
TRAIN = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'control'}
GAIN = 'roll.angle.kp'


class Attacker:
    """See the module."""

    def __init__(self, node: Any, tty: Path) -> None:
        kinds = {'/excitation/segment': STATE, '/gains/update': EVENT, '/logger/bag': STATE}
        self._events = {topic: node.create_publisher(ParameterEvent, topic, qos)
                        for topic, qos in kinds.items()}  # fmt: skip
        self._setpoint = node.create_publisher(Vector3Stamped, '/excitation/setpoint', STREAM)
        self._enable = node.create_publisher(Header, '/operator/enable', EVENT)
        self._described = node.create_publisher(String, '/robot_description', STATE)
        self._arm = node.create_client(SetBool, '/serial_bridge/arm')
        self._gains = node.create_client(SetParametersAtomically, '/serial_bridge/set_gains')
        self._line, self._ground = os.open(tty, os.O_WRONLY | os.O_NOCTTY), Encoder(255, 190)
        self._old = Header(stamp=time_message(OLD_NS), frame_id='base_link')
        many = event_message({f'x{k}': 1.0 for k in range(100_000)}, '/flood', 0)
        self._flood = bytearray(serialize_message(many))
        self.answers: list[Any] = []

    def play(self, number: int) -> None:
        """Speak as a bag that is played, a hundred times a second, and as others do."""
        played = Vector3Stamped(header=self._old)
        played.vector.x = 0.3
        self._setpoint.publish(played)
        self._enable.publish(self._old)
        if number % 10:
            return
        update = event_message({GAIN: 6.0, 'source': 'bag'}, '/played', OLD_NS)
        complete = {'path': '/etc', 'state': 'complete'}
        forged = event_message(complete, '/bag_logger', time.time_ns())
        self._events['/excitation/segment'].publish(event_message(TRAIN, '/played', OLD_NS))
        self._events['/gains/update'].publish(update)
        self._events['/logger/bag'].publish(forged)
        os.write(self._line, self._ground.encode(Heartbeat()))

    def flood(self) -> None:
        """Say what is large, or has an answer."""
        struct.pack_into('<iI', self._flood, 4, *divmod(time.time_ns(), 10**9))
        self._events['/gains/update'].publish(bytes(self._flood))
        self._described.publish(String(data='<robot>' + 5_000_000 * ' '))
        self.answers.append(self._arm.call_async(SetBool.Request(data=False)))
        for value in (math.nan, 1e9):
            wanted = event_message({GAIN: value}, '', 0).changed_parameters
            asked = SetParametersAtomically.Request(parameters=wanted)
            self.answers.append(self._gains.call_async(asked))


def main() -> None:
    listen_by_udp()
    folder = Path(sys.argv[1])
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopped, node = Stopped(), rclpy.create_node('attacker')
    executor, attacker, number = SingleThreadedExecutor(), Attacker(node, folder / 'tty'), 0
    executor.add_node(node)
    time.sleep(CALM_S)
    while not stopped.yes:
        executor.spin_once(timeout_sec=0.01)
        number += 1
        attacker.play(number)
        if number % 400 == 0:
            attacker.flood()
    given = [answer.result() for answer in attacker.answers if answer.done()]
    good = [one.success if hasattr(one, 'success') else one.result.successful for one in given]
    told = {'asked': len(attacker.answers), 'answered': len(given), 'obeyed': sum(good)}
    (folder / 'attack.json').write_text(json.dumps(told))


if __name__ == '__main__':
    main()
