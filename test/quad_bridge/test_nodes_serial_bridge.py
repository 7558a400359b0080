"""The nodes as processes: a flight controller on a pseudo-terminal, the bridge, logger, a bag."""

import fcntl
import os
import signal
import time
from collections import Counter
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from flight_controller import CYCLE_S, NUMBERS, FlightController, Port, Pty
from node_process import recorded
from probe import content, entries, event, stamp_ns

from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.nodes.serial_bridge import SerialBridge
from quad_bridge.topics import NODES
from quad_bridge.wire import frames as f

CONFIG = Path(__file__).resolve().parents[2] / 'src' / 'quad_bridge' / 'config'
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE, SHUTDOWN = 1, 2, 3, 4, 5
STATES = {CONFIGURE: 2, CLEANUP: 1, ACTIVATE: 3, DEACTIVATE: 2, SHUTDOWN: 4}
"""The state behind each transition, which nav2's lifecycle manager asks for at once."""
LINK, CLOCK, RECORDING = 'serial_bridge: link', 'serial_bridge: clock', 'bag_logger: recording'
PER_CYCLE = ('/motors/command', '/control/wrench', '/setpoint/rates', '/setpoint/attitude')


@pytest.mark.parametrize('takes_back', [True, False])
def test_only_what_goes_back_is_written_where_the_aircraft_takes_no_gains(takes_back):
    bridge = MagicMock()
    bridge._gains.takes_back.return_value = takes_back
    SerialBridge._ask_gains(bridge, {'rollback': True, 'roll.rate.kp': 0.05})
    assert bridge._refuse.called is not takes_back


@pytest.fixture
def far(tmp_path):
    """A flight controller that sends 250 numbered cycles a second."""
    with Port(FlightController(), Pty(tmp_path / 'tty')) as port:
        yield port


@pytest.fixture
def bridge(start, tmp_path):
    settings = {'port': tmp_path / 'tty', 'state_folder': tmp_path / 'state'}
    return lambda **more: start('serial_bridge', **{**settings, **more})


def bag_in(folder):
    (bag,) = (folder / 'bags').glob('flight_*')
    return bag


def numbers(imu):
    """Of each cycle: see FlightController.frame."""
    return np.array([round(1000 * m.angular_velocity.x) for m in imu])


def missing(imu):
    """How many cycles between the first and the last are not there; none came twice."""
    steps = np.diff(numbers(imu)) % NUMBERS
    assert steps.min() > 0
    assert steps.max() < NUMBERS / 2
    return int((steps - 1).sum())


def count(probe, name, key):
    return int(probe.diagnostics(name, key) or 0)


def test_replugged_under_another_name_the_flight_goes_on_into_the_bag(tmp_path, probe, start):
    """Between a frame on the wire and the bag no cycle is lost that nobody says was lost."""
    recorder = start('bag_logger', folder=tmp_path / 'bags', autostart=True)
    settings = {'port': f'{tmp_path}/ttyACM*', 'state_folder': tmp_path, 'polarity': 'off'}
    node = start('serial_bridge', **{f'serial_bridge:{name}': x for name, x in settings.items()},
                 files=[CONFIG / 'serial_bridge.yaml'])  # fmt: skip
    with Port(FlightController(), Pty(tmp_path / 'ttyACM0')) as first:
        probe.until(lambda: all(probe.listeners(topic) for topic in PER_CYCLE))
        begun = count(probe, RECORDING, 'messages written')
        probe.until(lambda: count(probe, RECORDING, 'messages written') > begun + 1000)
    probe.until(lambda: 'not there' in probe.diagnostics(LINK))
    # the flight controller has gone on meanwhile
    number = max(int((time.monotonic() - first.start_s) / CYCLE_S), first.controller.number + 100)
    again = FlightController(number=number)
    with Port(again, Pty(tmp_path / 'ttyACM1'), start_s=first.start_s) as second:
        probe.until(lambda: probe.diagnostics(LINK, 'times opened') == '2')
        probe.until(lambda: count(probe, LINK, 'lost cycles') > 0)
        probe.until(lambda: probe.diagnostics(CLOCK).startswith('converged'))
        recorder.send(signal.SIGSTOP)
        begin = again.number
        probe.until(lambda: again.number > begin + 375)  # 1.5 s; the middleware holds 4 s
        recorder.send(signal.SIGCONT)
        written = count(probe, RECORDING, 'messages written')  # a topic may be found late
        probe.until(lambda: count(probe, RECORDING, 'messages written') > written + 6000)
        second.halt()
        lost = count(probe, LINK, 'lost cycles')
        assert probe.diagnostics(LINK, 'device').endswith('ttyACM1')
        assert node.end() == 0
        told = probe.listen('/diagnostics')
        probe.until(lambda: sum(a.status[0].name == RECORDING for a in list(told)) > 1)
        assert recorder.end() == 0
    found = recorded(bag_in(tmp_path))
    imu = found['/imu/data']
    stamps = np.array([stamp_ns(m) for m in imu])
    assert np.diff(stamps).min() > 0
    assert np.median(np.diff(stamps)) == pytest.approx(4e6, abs=5e5)
    assert abs(1e-9 * stamps[-1] - time.time()) < 600.0
    assert imu[0].linear_acceleration.z == pytest.approx(9.81)
    assert imu[0].angular_velocity.y == -0.25
    index = np.cumsum(np.diff(numbers(imu), prepend=0) % NUMBERS)
    (gap,) = np.flatnonzero(np.diff(index) >= number - first.controller.number)
    assert len(imu) - gap > 100  # it went on
    assert stamps[gap + 1] - stamps[gap] == pytest.approx(4e6 * (index[gap + 1] - index[gap]), 0.2)
    assert lost >= number - first.controller.number
    said_lost = count(probe, RECORDING, 'messages lost (middleware)')
    assert missing(imu[: gap + 1]) + missing(imu[gap + 1 :]) <= said_lost  # no other gap
    for topic in PER_CYCLE:
        same = {stamp_ns(m) for m in found[topic]}
        # the logger finds one topic after the other, and may be ended between two
        wanted = {s for s in stamps.tolist() if min(same) <= s <= max(same)}
        assert len(wanted) > 500
        assert len(wanted - same) <= said_lost, topic
    assert set(content(found['/gains/active'][0])) == {*WIRE_NAMES, 'mixer.desaturation'}
    assert {LINK, CLOCK, RECORDING} <= {s.name for a in found['/diagnostics'] for s in a.status}
    lines = Counter(line.partition(']: ')[2] for line in node.said.splitlines())
    assert max(lines.values()) <= 2  # a cable that is pulled is not a flood of words


def test_two_aircraft_keep_apart_and_one_logs_inside_its_bridge(tmp_path, probe, bridge):
    own = {'folder': tmp_path / 'bags', 'autostart': True}
    inside = {'log': 'inside', **{f'bag_logger.{name}': x for name, x in own.items()}}
    heard, nodes = {}, []
    with (
        Port(FlightController(gyro=(0.0, 0.25, 0.5)), Pty(tmp_path / 'left')),
        Port(FlightController(gyro=(0.0, 0.75, 0.5)), Pty(tmp_path / 'right')),
    ):
        for name in ('left', 'right'):
            more = inside if name == 'left' else {}
            nodes.append(bridge(port=tmp_path / name, namespace=f'/{name}', **more))
            heard[name] = probe.listen(f'/{name}/imu/data')
        told = probe.listen('/left/diagnostics')
        probe.until(lambda: min(len(h) for h in heard.values()) > 300)
        probe.until(lambda: RECORDING in entries(told))  # the bridge may be the first to speak
        probe.until(lambda: int(entries(told)[RECORDING].values['messages written']) > 1000)
    assert [node.end() for node in nodes] == [0, 0]
    # in the bag topics have the contract's names, so that every analysis reads it
    found = recorded(bag_in(tmp_path))
    heard['bag'] = found['/imu/data']
    assert {*PER_CYCLE, '/gains/active', '/diagnostics', '/logger/bag'} <= {*found}
    times = {topic: [stamp_ns(m) for m in found[topic]] for topic in ('/imu/data', *PER_CYCLE)}
    assert all(same == times['/imu/data'] for same in times.values())  # not one is missing
    assert {stamp_ns(m) for m in list(heard['left'])[10:]} <= {*times['/imu/data']}
    rates = {name: {m.angular_velocity.y for m in list(imu)} for name, imu in heard.items()}
    assert rates == {'left': {-0.25}, 'right': {-0.75}, 'bag': {-0.25}}


def test_a_manager_leads_the_bridge_through_its_states(probe, far, bridge):
    node = bridge(managed=True, polarity='off')
    heard = probe.listen('/imu/data', reliable=False)  # by SensorDataQoS, as it chooses
    wire = [WIRE_NAMES['roll.rate.kp']]
    flown = far.controller.store.of(wire)

    def goes(transition):
        assert probe.transition('/serial_bridge', transition)
        now = probe.call('/serial_bridge/get_state', 'lifecycle_msgs/srv/GetState')
        assert now.current_state.id == STATES[transition]

    def silent_after(transition):
        goes(transition)
        begin, ended_ns = far.controller.number, time.time_ns()
        probe.until(lambda: far.controller.number > begin + 125)
        stamps = [message.header.stamp for message in heard]  # what is under way may come late
        assert all(10**9 * stamp.sec + stamp.nanosec < ended_ns for stamp in stamps)
        heard.clear()

    def opens(what, *names):
        """What the table says is open in this state, and no more."""
        own = {f'/serial_bridge/{name}' for name in NODES['serial_bridge'].offers}
        known = {*NODES['serial_bridge'].hears, *own}
        probe.until(lambda: probe.opened('serial_bridge')[what] & known == {*names}, what)

    def flies_new_gains():
        return probe.answer(probe.set_gains({'roll.rate.kp': 0.1})).result.successful

    probe.until(lambda: '/serial_bridge' in probe.nodes())
    opens('offers')
    silent_after(CONFIGURE)
    opens('offers', *(f'/serial_bridge/{name}' for name in NODES['serial_bridge'].offers))
    opens('hears')
    for _ in range(2):
        goes(ACTIVATE)
        probe.until(lambda: len(heard) > 50)
        opens('hears', *NODES['serial_bridge'].hears)
        probe.until(flies_new_gains)
        assert far.controller.store.of(wire) == pytest.approx((0.1,))
        silent_after(DEACTIVATE)
        assert far.controller.store.of(wire) == flown  # nobody would watch the new ones
        opens('hears')
    goes(CLEANUP)
    opens('offers')
    assert not probe.transition('/serial_bridge', ACTIVATE)  # not before configure
    for transition in (CONFIGURE, ACTIVATE):
        goes(transition)
    probe.until(flies_new_gains)
    assert 'has not confirmed' not in node.said
    far.close()  # it was armed, with its throttle up, when it was last heard
    arm = '/serial_bridge/arm', 'std_srvs/srv/SetBool'
    probe.until(lambda: 'nothing is received' in probe.call(*arm, data=True).message)
    assert 'call again within 2 s' in probe.call(*arm, data=False).message
    for transition in (DEACTIVATE, CLEANUP, SHUTDOWN):
        goes(transition)
    assert 'has not confirmed its old gains and mode' in node.said
    assert node.end() == 0


def test_nothing_that_is_sent_or_left_unanswered_stops_the_bridge(probe, far, bridge):
    node, controller = bridge(managed=True), far.controller
    controller.unanswered = (f.Command,)
    imu = probe.listen('/imu/data')

    def arm(on):
        return probe.ask('/serial_bridge/arm', 'std_srvs/srv/SetBool', data=on)

    assert probe.transition('/serial_bridge', CONFIGURE)
    refused = probe.answer(arm(False))
    assert (refused.success, refused.message) == (False, 'the node is not active')
    assert probe.transition('/serial_bridge', ACTIVATE)
    # a line that has been quiet for a moment, as where the machine is busy, is another refusal
    probe.until(lambda: imu and probe.answer(arm(True)).message == 'it is armed already')
    controller.flags, number = 0, controller.number + 1
    probe.until(lambda: numbers(imu[-1:]) > number)

    def unanswered():
        first, second = arm(True), arm(False)
        assert not probe.answer(first).success
        assert probe.answer(second).message == 'the STM32: no answer in 1 s'
        return 'nothing is received' not in first.result().message

    def said():
        return [command.parameters[0] for command in controller.told(f.Command)]

    probe.until(unanswered)
    check = probe.ask('/serial_bridge/check_polarity')
    probe.until(lambda: said().count(0.0) > 1)
    assert said().count(1.0) == 1
    # what no frame, float or parser can take
    segment = event({'segment': 'train', 'signal': 'prbs', 'injection': 'rate'})
    topics = ('/excitation/segment', '/gains/update', '/excitation/setpoint')
    probe.meet(*topics)
    begun = ('serial_bridge: excitation', 'injection')
    probe.say_until(lambda: probe.diagnostics(*begun) == 'rate', topics[0], segment)
    for predicted in ('[' * 200_000, '[' * 4000, '{"roll.peak": 1%s}' % ('0' * 400)):
        probe.publish(topics[1], event({'predicted': predicted}))
        probe.publish(topics[2], {'vector': {'x': 1e300}})
    dropped = ('serial_bridge: excitation', 'set-points dropped')
    probe.until(lambda: count(probe, *dropped) >= 3)
    probe.until(lambda: count(probe, 'serial_bridge: gains', 'refused') >= 2)
    assert count(probe, 'serial_bridge: bounds', 'refused, too large') == 1
    heard = len(imu)
    probe.until(lambda: len(imu) > heard + 250)
    values = [v for s in entries(probe.listen('/diagnostics')).values() for v in s.values]
    assert 'failed callbacks' not in values
    assert probe.transition('/serial_bridge', DEACTIVATE)
    # the check needs a flight controller that answers: this one says why it has ended
    assert not probe.answer(check).success
    assert node.end() == 0


def test_of_two_bridges_on_a_port_the_second_refuses_gains_and_says_why(tmp_path, probe, bridge):
    """It offers the same service: whoever asks it must not take it for the aircraft."""
    line = Pty(tmp_path / 'tty')
    with os.fdopen(os.open(line.link, os.O_RDWR | os.O_NOCTTY), 'rb', buffering=0) as first:
        fcntl.flock(first, fcntl.LOCK_EX | fcntl.LOCK_NB)
        bridge()
        probe.until(lambda: 'busy' in probe.diagnostics(LINK))
        result = probe.answer(probe.set_gains({'roll.rate.kp': 0.1})).result
    line.close()
    assert (result.successful, result.reason) == (
        False, f'{tmp_path}/tty is busy: another program has it open',
    )  # fmt: skip


def test_simulated_time_is_respected(probe, far, bridge):
    probe.advertise('/clock')
    imu, begin_s = probe.listen('/imu/data'), time.monotonic()
    node = bridge(use_sim_time=True)
    # a node's own clock stands still; its work and its words must not
    probe.until(lambda: 'nothing comes on /clock' in probe.diagnostics(CLOCK))
    probe.until(lambda: len(far.controller.told(f.TimeSync)) > 8)
    assert imu == []

    def enough():
        now_ns = round(1e9 * (5000.0 + time.monotonic() - begin_s))
        sec, nanosec = divmod(now_ns, 10**9)
        probe.publish('/clock', {'clock': {'sec': sec, 'nanosec': nanosec}})
        return len(imu) > 300

    probe.until(enough)
    stamps = 1e-9 * np.array([stamp_ns(m) for m in imu])[50:]
    assert 5000.0 < stamps[0] < 5000.0 + time.monotonic() - begin_s
    assert np.median(np.diff(stamps)) == pytest.approx(0.004, abs=5e-4)
    assert node.end() == 0
