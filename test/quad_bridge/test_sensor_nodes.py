"""A virtual STM32 that stands, bridge and logger as processes: calibrated, armed, and in the bag.

What the bridge subtracts is told in the bag; the command `sensors` has the readings back from it.
"""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy', reason='needs ROS 2')
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rosbags.highlevel import AnyReader
from std_srvs.srv import SetBool, Trigger

from quad_bridge.sensors.correction import from_values
from quad_bridge.sensors_command import main as sensors

WAIT_S = 60.0
IRON = [0.0, 5e-6, 0.0]
STANDING = """
mount: rig
airframe:
  mounts:
    rig: {damping_per_s: 0.4, bias_torque_nm: 0.0, torque_noise_nm_rthz: 0.0}
sensors: {gyro_calibration_error_rad_s: 0.02}
firmware: {auto_arm: false}
"""
START = {
    'virtual_stm32': 'import sys; from quad_bridge.virtual.process import main; sys.exit(main())',
    'serial_bridge': 'from quad_bridge.serial_bridge_node import main; main()',
    'bag_logger': 'from quad_bridge.bag_logger_node import main; main()',
}


@pytest.fixture
def spawn(ros_domain):
    del ros_domain
    started = []

    def start(name, *arguments):
        started.append(subprocess.Popen([sys.executable, '-c', START[name], *arguments]))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def call(ros_domain):
    context = rclpy.Context()
    context.init(domain_id=ros_domain)
    node = rclpy.create_node('caller', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def ask(kind, name, request):
        client = node.create_client(kind, name)
        assert client.wait_for_service(timeout_sec=WAIT_S)
        answer = client.call_async(request)
        executor.spin_until_future_complete(answer, timeout_sec=WAIT_S)
        return answer.result()

    yield ask
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()


def end(process):
    process.send_signal(signal.SIGINT)
    return process.wait(timeout=WAIT_S)


def messages(bag):
    found = {}
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def stamps_ns(found):
    return np.array([10**9 * m.header.stamp.sec + m.header.stamp.nanosec for m in found])


def xyz(vectors):
    return np.array([[v.x, v.y, v.z] for v in vectors])


def test_calibrated_at_rest_armed_and_recorded(tmp_path, spawn, call, capsys):
    (tmp_path / 'standing.yaml').write_text(STANDING)
    kept = tmp_path / 'state' / 'one' / 'sensors.yaml'
    kept.parent.mkdir(parents=True)
    kept.write_text(yaml.safe_dump({'sensors': {'compass': {'offset': IRON}}}))
    far = spawn(
        'virtual_stm32', '--profile', str(tmp_path / 'standing.yaml'), '--link',
        str(tmp_path / 'tty'), '--seed', '5',
    )  # fmt: skip
    logger = spawn(
        'bag_logger', '--ros-args', '-p', f'folder:={tmp_path / "bags"}', '-p', 'autostart:=true'
    )
    bridge = spawn(
        'serial_bridge', '--ros-args', '-p', f'port:={tmp_path / "tty"}', '-p', 'aircraft:=one',
        '-p', f'state_folder:={tmp_path / "state"}',
    )  # fmt: skip
    answer = None
    end_s = time.monotonic() + WAIT_S
    while (answer is None or not answer.success) and time.monotonic() < end_s:
        time.sleep(0.5)
        answer = call(Trigger, '/serial_bridge/calibrate_at_rest', Trigger.Request())
    assert answer.success, answer.message
    time.sleep(2.0)
    armed = call(SetBool, '/serial_bridge/arm', SetBool.Request(data=True))
    assert armed.success, armed.message
    refused = call(Trigger, '/serial_bridge/calibrate_at_rest', Trigger.Request())
    assert (refused.success, 'it is armed' in refused.message) == (False, True)
    time.sleep(1.5)
    assert [end(p) for p in (bridge, logger, far)] == [0, 0, 0]

    (bag,) = (tmp_path / 'bags').glob('flight_*')
    found = messages(bag)
    entries = {}
    for array in found['/diagnostics']:
        for status in array.status:
            entries.setdefault(status.name, []).append(status)
    told = [
        from_values({v.key: v.value for v in status.values})
        for status in entries['serial_bridge: sensors']
    ]
    # from the file, asked for, arming
    begins = sorted({one.since_ns for one in told if one.since_ns})
    assert len(begins) == 3
    assert {c.hard_iron for c in told if c.since_ns} == {tuple(IRON)}
    stamps = stamps_ns(found['/imu/data'])
    rates = xyz([m.angular_velocity for m in found['/imu/data']])
    before = rates[stamps < begins[1]].mean(axis=0)
    # it moves as soon as it is armed, the bridge's tick comes up to 0.1 s later
    after = rates[(stamps >= begins[1]) & (stamps < begins[2] - 3 * 10**8)]
    assert np.abs(before).max() > 5e-3
    # six seconds averaged, two compared, noise of 5e-3 rad/s, neighbours related by the filter
    assert np.abs(after.mean(axis=0)).max() < 2e-3
    written = yaml.safe_load(kept.read_text())['sensors']
    assert written['compass'] == {'offset': IRON}
    assert written['rest']['source'] == 'the bridge, arming'
    assert written['rest']['gyro_bias'] == pytest.approx(before, abs=2e-3)

    mag = found['/imu/mag']
    field = xyz([m.magnetic_field for m in mag])
    late = stamps_ns(mag) > begins[0] + 10**8
    assert field[late].mean(axis=0)[1] == pytest.approx(24e-6 - 5e-6, abs=1e-6)
    vibration = entries['serial_bridge: vibration of the rates'][-1]
    assert any(v.key == 'peak (Hz)' for v in vibration.values)

    stood = str(1e-9 * (begins[2] - stamps[0]) - 0.3)
    sensors(['rest', str(bag), '--out', str(tmp_path / 'again.yaml'), '--seconds', stood])
    capsys.readouterr()
    again = yaml.safe_load((tmp_path / 'again.yaml').read_text())['sensors']['rest']
    assert again['gyro_bias'] == pytest.approx(before, abs=2e-3)
