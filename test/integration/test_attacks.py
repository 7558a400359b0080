"""All attacks on a flying aircraft at once, through real processes: the log is whole, it flies on.

They come over ROS, where anybody in the domain may speak, and as another MAVLink sender on the
line. What a key or SROS2 keeps out is not tried here.
"""

import math
import signal

import numpy as np
import pytest
from flight_controller import Device, Relay, Socket
from node_process import program, recorded
from probe import content, event, stamp_ns

from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder

FLIGHT_S, CYCLE_NS = 120, 4_000_000
LOST_S = 2.0  # without the bridge, after which gains on trial are taken back
OLD = {'stamp': {'sec': 1_000_000_000, 'nanosec': 1}}
"""The time of a recording."""
KP, GOOD = 'roll.angle.kp', 3.3
TRAIN = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'control'}
FLOOD = event({f'parameter_{k}': 1.0 for k in range(5000)})
ARM = ('/serial_bridge/arm', 'std_srvs/srv/SetBool')
LOST = (('serial_bridge: link', 'lost cycles'), ('serial_bridge: clock', 'cycles held back'))
LINK, RECORDING = 'serial_bridge: link', 'bag_logger: recording'


def attack(probe):
    """What goes on by itself: a bag that is played, an enable of the past, forged bags."""
    played = {**OLD, 'frame_id': 'base_link'}
    probe.publish('/excitation/setpoint', {'header': played, 'vector': {'x': 0.3}}, every_s=0.01)
    probe.publish('/excitation/segment', {**event(TRAIN), **OLD}, every_s=0.2)
    probe.publish('/operator/enable', {**OLD, 'frame_id': 'operator'}, every_s=0.02)
    probe.publish('/gains/update', {**event({KP: 6.0, 'source': 'bag'}), **OLD}, every_s=0.05)
    forged = {**event({'path': '/etc', 'state': 'complete'}), 'node': '/bag_logger'}
    probe.publish('/logger/bag', forged, every_s=0.1)


def attack_again(probe):
    """What has an answer, or is large."""
    refused = probe.call(*ARM, data=False)
    assert not refused.success, refused.message
    probe.publish('/gains/update', FLOOD, event({KP: math.nan, 'source': 'stranger'}))
    probe.publish('/robot_description', {'data': '<robot>' + 70_000 * ' '})
    for wanted in ({KP: math.nan}, {KP: 1e9}, {f'x{k}': 1.0 for k in range(600)}):
        answer = probe.answer(probe.set_gains(wanted)).result
        assert not answer.successful, answer.reason
    probe.publish('/gains/update', {**event({KP: 6.0, 'source': 'bag'}), **OLD}, every_s=0.05)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_all_attacks_at_once_in_flight(tmp_path, run, start, probe):
    link, bags = tmp_path / 'tty', tmp_path / 'bags'
    aircraft = run(*program('virtual_stm32'), '--link', link, '--seed', 3)
    aircraft.until(lambda: 'virtual STM32 on' in aircraft.printed)
    imu, active, applied = (
        probe.listen(topic) for topic in ('/imu/data', '/gains/active', '/excitation/applied')
    )
    with Relay(Device(link), Socket()) as line:
        down, carry = bytearray(), line.down.carry
        line.down.carry = lambda data: (down.extend(data), carry(data))[1]
        inside = {'log': 'inside', 'bag_logger.folder': bags, 'bag_logger.autostart': True}
        bridge = start('serial_bridge', port=line.ends[1].url, polarity='off',
                       state_folder=tmp_path / 'state', **inside)  # fmt: skip
        probe.until(lambda: len(imu) > 250 and active and probe.diagnostics(LINK))
        begin_ns, flown = stamp_ns(imu[-1]), content(active[-1])
        attack(probe)
        ground, mark = Encoder(255, 190), len(imu)
        while stamp_ns(imu[-1]) < begin_ns + FLIGHT_S * 10**9:
            line.ends[0].write(ground.encode(f.Heartbeat()))
            if len(imu) - mark > 1000:  # some four seconds
                mark = len(imu)
                attack_again(probe)
            heard = len(imu)
            probe.until(lambda heard=heard: len(imu) > heard + 20)
        lost = sum(int(probe.diagnostics(name, key)) for name, key in LOST)
        assert probe.diagnostics(RECORDING, 'messages dropped (disk)') == '0'
        assert 'armed already' in probe.call(*ARM, data=True).message
        assert (content(active[-1]), list(applied)) == (flown, [])

        # gains on trial; then the bridge is gone, and somebody else still speaks
        probe.silence('/gains/update')
        answer = probe.answer(probe.set_gains({KP: GOOD})).result
        assert answer.successful, answer.reason
        assert probe.call('/bag_logger/stop').success
        bridge.send(signal.SIGKILL)
        bridge.wait()
        gone = len(down)

        def states():
            line.ends[0].write(ground.encode(f.Heartbeat()))
            found = Decoder().feed(bytes(down[gone:]))
            return f.GainsResult.LINK_LOST in [
                one.result for one in found if isinstance(one, f.GainsState)
            ]

        probe.until(states, 'the revert', pause_s=0.05)
        times = [one.time_us if isinstance(one, f.Cycle) else getattr(one, 'result', None)
                 for one in Decoder().feed(bytes(down[gone:]))]  # fmt: skip
    revert = times.index(f.GainsResult.LINK_LOST)
    cycles = [time for time in times[:revert] if time is not None and time > 1000]
    assert 1e-6 * (cycles[-1] - cycles[0]) == pytest.approx(LOST_S, abs=1.0)
    aircraft.end()

    (bag,) = bags.glob('flight_*')
    assert (bag / 'metadata.yaml').exists()
    found = recorded(bag)
    stamps = np.array([stamp_ns(m) for m in found['/imu/data']])
    assert stamps[-1] - begin_ns > FLIGHT_S * 10**9
    missing = (np.rint(np.diff(stamps[stamps >= begin_ns]) / CYCLE_NS) - 1).sum()
    assert missing <= lost
    for topic in ('/motors/command', '/control/wrench', '/setpoint/attitude', '/setpoint/rates'):
        assert [stamp_ns(m) for m in found[topic]] == stamps.tolist(), topic
    rates = np.array([(m.angular_velocity.x, m.angular_velocity.y) for m in found['/imu/data']])
    before = stamps < begin_ns
    calm, attacked = (np.sqrt((rates[which] ** 2).mean()) for which in (before, ~before))
    assert attacked < max(2.0 * calm, 0.1)  # rad/s; 0.3 of control made 5.5
