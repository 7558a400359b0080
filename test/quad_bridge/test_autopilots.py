"""Gains and excitation on PX4 and ArduPilot, flown by the stand-ins, in memory.

The bridge's parts are joined as the node joins them; the aircraft's files lie in a folder.
"""

import json
import math
import re
from dataclasses import replace

import flying_autopilot as flown
import pytest
from autopilots import INERTIAL
from flight_controller import CYCLE_S, FlightController, Port, Pty, Updated
from flying_autopilot import FLYING_ARDUPILOT, FLYING_PX4, Flying

from quad_bridge.aircraft import Ability
from quad_bridge.autopilots.aircraft import Connected
from quad_bridge.autopilots.check import lines, report
from quad_bridge.autopilots.check import main as check
from quad_bridge.autopilots.flight import FlightState
from quad_bridge.autopilots.gains import ParameterGains
from quad_bridge.autopilots.guard import Guard
from quad_bridge.autopilots.kinds import BY_NUMBER
from quad_bridge.autopilots.system_id import sid_parameters
from quad_bridge.autopilots.table import ARDUPILOT, PX4, UnfitError
from quad_bridge.autopilots.takeover import Takeover
from quad_bridge.errors import RefusedError
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.gains.update import GainSettings, State
from quad_bridge.link.autopilot import Inertial, fitted, load
from quad_bridge.link.machine import Link
from quad_bridge.link.parameters import Parameters
from quad_bridge.link.stamping import Arrived, Described, Stamped
from quad_bridge.motor_outputs import motor_outputs
from quad_bridge.virtual.physics import POSITION, VELOCITY
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import angles_of

KINDS = {
    name: replace(kind, most_hz={n: min(hz, 62.5 if n in INERTIAL else 25.0)
                                 for n, hz in kind.most_hz.items()})
    for name, kind in (('px4', FLYING_PX4), ('ardupilot', FLYING_ARDUPILOT))
}
"""At rates that a modest line carries: what is tested here is no matter of rates."""
P = {'px4': 'MC_ROLLRATE_P', 'ardupilot': 'ATC_RAT_RLL_P'}
both = pytest.mark.parametrize('name', KINDS)


class Cockpit(Updated):
    """The bridge as the node joins it, and one of the flying stand-ins."""

    def __init__(self, name, folder, *, gains=True, excitation=True, aircraft=None):
        self.settings, self.allow = GainSettings(folder=folder), (gains, excitation)
        self.cycles = []
        super().__init__(aircraft or Flying(KINDS[name]))

    def connect(self, link):
        """A bridge begins; one that was there is killed."""
        gains, excitation = self.allow
        self.connected = Connected(
            lambda: '', lambda: 1e-9 * self.now_ns, allow_gains=gains, allow_excitation=excitation)
        self.relay = ExcitationRelay(100, None, lambda: self.connected.aircraft)
        self.connected.on_change = self.changed
        super().connect(link)

    def opened(self):
        super().opened()
        self.connected.doubt()

    def changed(self, aircraft):
        self.updates.use(aircraft.gains)
        self.link.describe_again()
        known = self.connected.autopilot
        self.link.autopilot.also_hz = {} if known is None else known.kind.requested_hz

    def handle(self, event):
        now_s = 1e-9 * self.now_ns
        if isinstance(event, Arrived):
            self.connected.take(event.frame, now_s)
            if isinstance(event.frame, f.ParamValue) and self.connected.has_gains:
                self.updates.take(event.frame, now_s)
        elif isinstance(event, Stamped):
            self.connected.take(event.frame, now_s)
            aircraft = self.connected.autopilot
            if isinstance(event.frame, Inertial) and aircraft is not None:
                cycle = aircraft.cycle(event.frame, now_s)
                if cycle is not None:
                    self.cycles.append(cycle)
                    self.updates.cycle(cycle, now_s)
        elif isinstance(event, Described):
            outputs = motor_outputs(event.peer.autopilot, '', event.parameters)
            self.connected.autopilot.describe(outputs.craft)

    def poll(self):
        now_s = 1e-9 * self.now_ns
        request = self.updates.poll(now_s) if self.connected.has_gains else None
        for frame in [*([request] if request else []), *self.connected.poll(now_s)]:
            self.link.send(frame)

    # What operators and nodes do.

    @property
    def aircraft(self):
        return self.connected.autopilot

    def ask(self, **gains):
        """Ask as ~/set_gains does; keys with _ for dots: roll_rate_kp."""
        wanted = {name.replace('_', '.', 2): value for name, value in gains.items()}
        fault = self.connected.aircraft.cannot(Ability.GAINS)
        if fault:
            raise RefusedError(fault)
        return self.updates.ask({'source': 'test', **wanted}, 1e-9 * self.now_ns)

    def segment(self, **given):
        said = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'attitude'}
        frame = self.relay.segment({**said, **given})
        assert frame is None

    def excite(self, seconds, size, period_s=1.0):
        """Play a square on roll and on pitch, 250 set-points a second: one of them is excited."""
        for k in range(round(seconds / 0.004)):
            value = size if (k * 0.004) % period_s < period_s / 2 else -size
            self.relay.setpoint(value, value, 0.0, 1e-9 * self.now_ns)
            self.run()

    def kept(self):
        paths = [*self.settings.folder.glob('*/trial.json')]
        return json.loads(paths[0].read_text()) if paths else {}


@pytest.fixture
def flying(tmp_path):
    """A function that makes a cockpit whose aircraft has hovered for some seconds."""

    def made(name, **more):
        there = Cockpit(name, tmp_path, **more)
        there.fly(3.0)
        return there

    return made


@both
def test_gains_are_read_written_watched_and_confirmed(flying, name):
    line = flying(name)
    unit = 0.70711 if name == 'px4' else 0.5
    before = line.controller.parameters[P[name]]
    active = line.updates.active
    assert active['roll.rate.kp'] == pytest.approx(unit * before, rel=1e-4)
    assert active['sensor.gyro_filter_hz'] == 40.0
    wanted = 2.4 * unit * before
    line.ask(roll_rate_kp=wanted)  # in two steps: answers to questions come after the second
    line.fly(5.0)
    assert line.controller.parameters[P[name]] == pytest.approx(2.4 * before, rel=1e-5)
    assert line.updates.state is State.WATCHING
    assert line.kept()['trial']['good'][P[name]] == pytest.approx(before)
    with pytest.raises(RefusedError, match='an earlier update is in flight'):
        line.ask(roll_rate_kp=wanted)
    line.fly(10.0)
    assert line.updates.refused == ''
    assert line.updates.state is State.IDLE
    assert line.updates.active['roll.rate.kp'] == pytest.approx(wanted, rel=1e-4)
    assert 'trial' not in line.kept()
    assert any('confirmed' in text for text in line.notes)


def test_a_disk_that_fills_between_two_steps_ends_the_trial(flying):
    line, p = flying('px4'), P['px4']
    before = line.controller.parameters[p]
    line.ask(roll_rate_kp=2.4 * line.updates.active['roll.rate.kp'])
    line.fly(1.0)
    assert line.controller.parameters[p] > 1.9 * before
    line.updates.protocol.keep = lambda _, done: done(False)
    line.fly(6.0)
    assert line.controller.parameters[p] == before
    assert 'the next step was not written' in ' '.join(line.notes)


@pytest.mark.parametrize(('name', 'cut_s'), [('px4', 0.0), ('ardupilot', 4.0)])
def test_a_bridge_that_ends_takes_back_what_nobody_would_watch(flying, name, cut_s):
    """An aircraft that is not heard may hear the bridge all the same."""
    line, p = flying(name), P[name]
    before, active = dict(line.controller.parameters), line.updates.active
    line.ask(**{f'roll_rate_{n}': 1.4 * active[f'roll.rate.{n}'] for n in ('kp', 'ki', 'kd')})
    line.fly(1.0)
    assert line.controller.parameters[p] > 1.3 * before[p]
    line.updates.end('the node was deactivated')
    assert not line.aircraft.at_rest
    line.down.cut = cut_s > 0.0
    line.fly(cut_s)
    assert line.controller.parameters == before or not cut_s
    line.down.cut = False
    line.fly(1.0)
    assert line.aircraft.at_rest
    assert line.controller.parameters == before
    assert line.updates.state is State.IDLE
    assert 'trial' not in line.kept()


def test_the_first_gains_after_the_connection_are_watched_also_while_it_lands(flying):
    line, p = flying('px4'), P['px4']
    before, flight = line.controller.parameters[p], line.aircraft.flight
    take = flight.take
    flight.take = lambda frame, now_s: take(
        f.LandedState(4) if isinstance(frame, f.LandedState) else frame, now_s)
    line.ask(roll_rate_kp=9.5 * line.updates.active['roll.rate.kp'], roll_angle_kp=11.9)
    line.fly(15.0)
    assert line.updates.rollbacks == 1
    assert line.controller.parameters[p] == before
    assert abs(line.controller.angles[0]) < 0.6


@both
@pytest.mark.parametrize('attempts', [2, pytest.param(20, marks=pytest.mark.long)])
def test_a_bridge_that_was_killed_puts_the_last_good_set_back(flying, name, attempts):
    """However far the trial was, on a clean line and a noisy one: all of them."""
    line = flying(name)
    table = PX4 if name == 'px4' else ARDUPILOT
    before = {n: line.controller.parameters[n] for n in table.written}

    kp = line.updates.active['roll.rate.kp']
    for attempt in range(attempts):
        line.ask(roll_rate_kp=1.5 * kp, roll_rate_ki=1.2 * line.updates.active['roll.rate.ki'])
        line.run(1 + 220 * attempt // attempts)
        line.allow = (attempt + 1 < attempts, True)  # with `gains` off too the good set goes back
        line.connect(Link())  # -9: nothing is said to the aircraft, nothing of the old one is left
        line.down.noise = line.up.noise = 5e-4 * (attempt % 2)
        line.fly(5.0)
        now = {n: line.controller.parameters[n] for n in before}
        assert now == before, attempt
        assert 'trial' not in line.kept()
        assert line.updates.state is State.IDLE


def test_another_aircraft_on_the_port_gets_nothing_of_the_last_ones_trial(flying):
    line, p = flying('px4'), P['px4']
    first, before = line.controller, line.controller.parameters[p]
    line.ask(roll_rate_kp=1.4 * line.updates.active['roll.rate.kp'])
    line.fly(3.0)
    assert first.parameters[p] != before
    other = Flying(KINDS['px4'], uid=0x9999)
    lose(line, 0.0, opened=True, then=other)
    assert line.updates.aircraft == 'px4_0000000000009999'
    assert not other.written
    lose(line, 0.0, opened=True, then=first)
    assert first.parameters[p] == before
    lose(line, 11.0, opened=False, then=other)  # on a radio no port is opened
    assert line.updates.aircraft == 'px4_0000000000009999'
    assert line.updates.active
    assert not other.written


def mute(controller):
    """One that does not know the request for its version, and so never says which one it is."""
    answer = controller._command
    controller._command = lambda command: 3 if command.command == 512 else answer(command)
    return controller


@pytest.mark.parametrize(('name', 'first', 'second'), [
    ('px4', mute, lambda it: it), ('ardupilot', lambda it: it, mute)])
def test_nothing_is_written_to_one_that_may_be_another(tmp_path, name, first, second):
    """On a radio, and after one of the two has been silent about itself."""
    line = Cockpit(name, tmp_path, aircraft=first(Flying(KINDS[name])))
    line.fly(6.0)
    before = line.controller.parameters[P[name]]
    line.ask(roll_rate_kp=1.4 * line.updates.active['roll.rate.kp'])
    line.fly(3.0)
    other = second(Flying(KINDS[name], uid=0x9999))
    lose(line, 11.0, opened=False, then=other)
    other.parameters[P[name]] = before
    for written in (PX4 if name == 'px4' else ARDUPILOT).written:
        line.hear(other.pack(other.value(written)))  # as a ground station that reads them
    line.fly(1.0)
    assert not other.written
    assert line.kept()['trial']['good'][P[name]] == pytest.approx(before)


@pytest.mark.parametrize(('gap_s', 'opened'), [(0.5, True), (4.0, False), (12.0, False)])
def test_what_flew_when_the_line_broke_goes_back_when_it_is_heard_again(flying, gap_s, opened):
    """The mode and SID_* of an experiment, and the gains of a trial before it."""
    line, p = flying('ardupilot'), P['ardupilot']
    before, sound = line.controller.mode, dict(line.controller.parameters)
    line.segment(signal='chirp', injection='control', **CHIRP)
    line.excite(4.0, 0.0)
    assert line.controller.mode != before
    if not opened:  # it may hear without being heard
        line.down.cut = True
        line.fly(1.0)
        assert line.controller.parameters['SID_AXIS'] == 0
    lose(line, gap_s, opened=opened)
    assert line.controller.mode == before
    line.ask(roll_rate_kp=1.4 * line.updates.active['roll.rate.kp'])
    line.fly(3.0)
    assert line.controller.parameters[p] != sound[p]
    told = []
    if opened:  # in a rollback, whose answer waits until they are back
        line.updates.ask({'rollback': True}, 1e-9 * line.now_ns,
                         lambda ok, _: told.append((ok, line.controller.parameters[p])))
    line.updates.restarted()
    assert line.updates.state is State.IDLE
    assert not line.aircraft.at_rest  # a bridge that ends now waits for the way back
    lose(line, max(gap_s, 1.5), opened=opened)
    assert told == [(True, sound[p])] * opened
    assert line.controller.parameters == sound
    assert line.aircraft.at_rest


def lose(line, gap_s, *, opened, then=None):
    """Nothing is heard of the aircraft, which hovers; `then`: another one that is heard next."""
    line.up.cut = line.down.cut = True
    for _ in range(round(gap_s / CYCLE_S)):
        line.steps, line.controller.step = line.steps + 1, line.controller.step + 1
        line.attend()
    line.up.cut = line.down.cut = False
    line.controller = then or line.controller
    if opened:
        line.opened()
    line.fly(6.0)


def test_a_ground_station_that_writes_during_a_trial_ends_it(flying):
    line, p = flying('ardupilot'), P['ardupilot']
    before, kp = line.controller.parameters[p], line.updates.active['roll.rate.kp']
    line.ask(roll_rate_kp=1.4 * kp)
    line.fly(3.0)
    line.controller.parameters[p] = 0.9 * before  # over another line: nobody tells us
    line.fly(2.0)
    assert line.controller.parameters[p] == before
    assert 'by another program' in ' '.join(line.notes)
    line.controller.parameters[p] = other = 0.8 * before
    line.hear(line.controller.pack(line.controller.value(p)))
    line.fly(2.0)
    assert line.controller.parameters[p] == other  # is left alone
    with pytest.raises(RefusedError, match='until the bridge is restarted'):
        line.ask(roll_rate_kp=kp)


@pytest.mark.parametrize(('other', 'ours'), [
    ('MC_ROLLRATE_K', 'roll.rate.kp'), ('MC_ROLLRATE_MAX', 'roll.angle.rate_limit')])
def test_what_acts_beside_the_gains_is_active_too_and_ends_a_trial(flying, other, ours):
    line, p = flying('px4'), P['px4']
    values, active, before = line.controller.parameters, line.updates.active[ours], {}
    for trial in (False, True):
        before[trial] = values[p]
        if trial:
            line.ask(roll_rate_kp=1.4 * line.updates.active['roll.rate.kp'])
            line.fly(3.0)
            del line.updates.protocol.values[other]  # as if it had not answered before
            line.hear(line.controller.pack(line.controller.value(other)))
            line.fly(1.0)
            assert values[p] == pytest.approx(1.4 * before[trial])
        values[other] *= 2.0
        line.hear(line.controller.pack(line.controller.value(other)))
        line.fly(2.0)
        assert line.updates.active[ours] == pytest.approx(active * (4.0 if trial else 2.0))
    assert values[p] == before[True]
    assert f'{other} was set to' in ' '.join(line.notes)


@pytest.mark.parametrize(('name', 'deaf'), [
    ('px4', ''), ('ardupilot', ''), ('ardupilot', 'FRAME_TYPE')])
def test_a_craft_that_did_not_describe_itself_at_first_does_so_later(tmp_path, name, deaf):
    """A radio may drop out for seconds; without a craft no gain has a unit, and none is read.

    One that was taken for another is corrected, and the gains are read in its units.
    """
    line = Cockpit(name, tmp_path)
    answers, line.controller._answers = line.controller._answers, lambda m: (
        () if m.get_type() == 'PARAM_REQUEST_READ' and m.param_id.startswith(deaf) else answers(m))
    line.fly(4.0)
    first, crafts, describe = line.aircraft.craft, [], line.aircraft.describe
    assert (first is None) is (deaf == '')
    line.aircraft.describe = lambda craft: crafts.append(craft) or describe(craft)
    line.controller._answers = answers
    line.fly(16.0)
    assert line.aircraft.craft not in {first, None}
    assert set(crafts) == {line.aircraft.craft}  # with the first answers it is not yet known
    assert not deaf or sum('read back' in text for text in line.notes) == 2
    assert len(line.updates.active) == (32 if name == 'ardupilot' else 30)
    line.controller.heard.clear()
    line.fly(5.0)
    assert line.controller.heard.count('PARAM_REQUEST_READ') < 30  # for what it does not know


def test_a_craft_that_is_described_anew_ends_a_trial_where_its_units_change(flying):
    """And says so; under another name, or not described (a line was silent), it is the same."""
    line, p = flying('px4'), P['px4']
    before, kp, craft = line.controller.parameters[p], *(
        line.updates.active['roll.rate.kp'], line.aircraft.craft)
    line.ask(roll_rate_kp=1.4 * kp)
    line.fly(3.0)
    for same in (replace(craft, name='another name'), None):
        line.aircraft.describe(same)
        line.fly(0.5)
        assert line.updates.state is State.WATCHING
    line.aircraft.describe(replace(craft, motors=tuple(
        replace(motor, x=2.0 * motor.x, y=4.0 * motor.y) for motor in craft.motors)))
    line.fly(1.0)
    assert line.controller.parameters[p] == before
    assert 'described anew' in line.updates.refused
    assert line.updates.active['roll.rate.kp'] != pytest.approx(kp, rel=0.01)


def test_where_one_answers_late_the_others_are_waited_for_too():
    """Otherwise a FRAME_CLASS without its FRAME_TYPE would be a craft for a moment."""
    asked = Parameters(f.Heartbeat(2, 3))
    times_ns = iter(range(0, 10**10, 10**8))
    while not asked.complete:
        asked.due(next(times_ns))
    asked.take(f.ParamValue('RCMAP_THROTTLE', math.nan, 1, 0, 2))  # which is no integer
    asked.take(f.ParamValue('FRAME_CLASS', 1.0, 1, 0))
    assert asked.values == {'FRAME_CLASS': 1.0}
    assert not asked.complete
    assert 'FRAME_TYPE' in {request.name for _ in range(40) for request in
                            asked.due(next(times_ns))}  # fmt: skip


def test_parameters_that_a_silent_line_has_not_brought_are_read_later():
    """Otherwise 23 of 32 gains are all that the bridge ever knows, and the unit may be wrong."""
    gains, hover = ParameterGains(ARDUPILOT, bytewise=False), 'MOT_THST_HOVER'
    gains.units = lambda known: (known.get(hover, 0.35),) * 3
    gains.want(hover)
    for k in range(3000):
        request = gains.poll(0.02 * k)
        heard = 62 < k < 80 or k > 260  # the line breaks
        if request is not None and heard:
            gains.take(f.ParamValue(request.name, 0.25, 1, 0), 0.02 * k)
        if k == 260:
            assert gains.state.value == 'read back'
            assert not set(ARDUPILOT.names) <= set(gains.values)
            assert hover not in gains.values
    assert set(gains.values) == {*ARDUPILOT.names, hover}
    assert gains.active['roll.rate.output_limit'] == 0.25
    assert gains.poll(100.0) is None


def test_what_a_parameter_may_not_be_is_refused_in_one_line():
    known = {'MC_ROLLRATE_K': 1.0}
    with pytest.raises(UnfitError, match=r'rate.kd: MC_ROLLRATE_D must lie in 0 .. 0.01: f'):
        PX4.parameters({'roll.rate.kd': 0.04}, known, (0.7, 0.7, 1.0))
    with pytest.raises(UnfitError, match='no such gain that can be set'):
        ARDUPILOT.parameters({'roll.lqr.share': 0.5}, {}, (0.5, 0.5, 0.5))
    lowest = PX4.parameters({f'{a}.rate.d_filter_hz': v for a, v in
                             (('roll', 30.0), ('pitch', 40.0))}, {}, (1.0, 1.0, 1.0))
    assert lowest == {'IMU_DGYRO_CUTOFF': 30.0}


def test_px4_is_excited_on_one_axis_and_given_back(flying):
    line = flying('px4')
    height = line.aircraft.flight.height_m
    line.segment()
    line.excite(3.0, 0.1)
    assert line.controller.mode == flown.OFFBOARD
    line.controller.craft.machine.state[VELOCITY : VELOCITY + 2] = 1.2, -0.8  # a gust
    line.excite(7.0, 0.1)
    assert line.controller.mode == flown.OFFBOARD
    assert max(abs(line.controller.craft.machine.state[POSITION : POSITION + 2])) < 1.0
    applied = [c.excitation for c in line.cycles[-500:]]
    assert max(a[0] for a in applied) == pytest.approx(0.1, abs=1e-3)
    assert min(a[0] for a in applied) == pytest.approx(-0.1, abs=1e-3)
    assert all(a[1] == a[2] == 0.0 for a in applied)
    assert all(c.injection == f.Injection.ATTITUDE for c in line.cycles[-200:])
    assert abs(line.aircraft.flight.height_m - height) < 0.5
    line.relay.segment({'segment': 'idle', 'signal': 'none'})
    line.fly(3.0)
    assert line.controller.mode == flown.POSITION_MODE
    assert line.aircraft.takeover.phase.value == 'idle'
    assert not line.aircraft.cannot(Ability.EXCITE)


def test_ardupilots_system_id_is_set_up_followed_and_put_back(flying):
    line = flying('ardupilot')
    before = dict(line.controller.parameters)
    line.segment(signal='chirp', injection='control', axis='pitch', amplitude=0.06, f0_hz=1.0,
                 f1_hz=8.0, sweep_s=12.0, ramp_s=0.5)
    line.excite(6.0, 0.06)  # the excitation node plays the chirp too, though it is not sent
    assert line.controller.mode == flown.SYSTEM_ID
    assert line.controller.parameters['SID_AXIS'] == 11
    assert not line.aircraft.at_rest
    assert line.controller.parameters['SID_MAGNITUDE'] == pytest.approx(0.06)
    assert any(c.flags & f.Flag.EXCITATION for c in line.cycles[-10:])
    line.excite(6.5, 0.06)
    assert line.controller.mode == flown.STABILIZE  # by itself, within the segment
    line.relay.segment({'segment': 'idle', 'signal': 'none'})
    line.fly(2.0)
    assert line.aircraft.at_rest
    assert line.controller.parameters == before
    assert max(abs(row[-1]) for row in line.controller.rows if math.isfinite(row[-1])) > 0.05
    assert line.aircraft.cannot(Ability.EXCITE) == ''
    for given, words in (({'amplitude': 0.9}, 'at most 0.25'), ({'axis': 'nose'}, "axis 'nose'")):
        line.segment(signal='chirp', injection='control', **{**CHIRP, **given})
        line.fly(0.5)
        assert words in line.connected.aircraft.cannot(Ability.EXCITE)
        assert line.controller.parameters == before


CHIRP = {'amplitude': 0.05, 'f0_hz': 1.0, 'f1_hz': 8.0, 'sweep_s': 20.0}


@pytest.mark.parametrize('case', ['sticks', 'let go', 'silence', 'silence in flight'])
def test_system_id_is_left_before_its_parameters_go_back(flying, case):
    """Just entered, the heartbeat does not say so yet. A schedule that falls silent ends it too:
    the limits of the excitation node and the pilot's abort switch have gone with it.
    """
    line = flying('ardupilot')
    controller, sid = line.controller, line.aircraft.system_id
    before = dict(controller.parameters)
    line.segment(signal='chirp', injection='control', axis='pitch', **CHIRP)
    while controller.mode != flown.SYSTEM_ID:
        line.excite(0.004, 0.05)
    assert line.aircraft.flight.mode == flown.STABILIZE
    if case == 'silence in flight':
        line.excite(5.0, 0.05)
        assert controller.mode == flown.SYSTEM_ID
    elif case == 'sticks':
        controller.sticks[0] = 0.3
    elif case == 'let go':
        line.relay.segment({'segment': 'idle', 'signal': 'none'})
    for k in range(1250):
        (line.run if 'silence' in case else lambda: line.excite(0.004, 0.05))()
        is_left = controller.mode == flown.STABILIZE
        assert is_left or (k < 100 and controller.parameters['SID_AXIS'] == 11)
    assert controller.parameters == before
    assert sid.phase.value == 'idle'
    words = {'sticks': 'sticks were moved', 'let go': ''}.get(case, 'has been silent')
    assert words in sid.refusal
    assert bool(words) == bool(sid.refusal)


@pytest.mark.parametrize(('name', 'injection', 'signal', 'flies'), [
    ('px4', 'attitude', 'prbs', True), ('ardupilot', 'attitude', 'prbs', False),
    ('ardupilot', 'control', 'chirp', True), ('ardupilot', 'control', 'chirp', False)])
def test_the_mode_that_the_pilot_chooses_between_two_heartbeats_stays(
        flying, name, injection, signal, flies):
    """With the stick that ends the excitation, or just before its mode is asked for."""
    line = flying(name)
    controller, chosen = line.controller, 0x6040000 if name == 'px4' else 9  # Land
    line.excite(0.02, 0.05)  # the heartbeat of this second has come
    line.segment(signal=signal, injection=injection, **(CHIRP if signal == 'chirp' else {}))
    while not any(mode.flying for mode in line.aircraft._modes) if flies else (
            signal == 'prbs' and controller.step < 1010):
        line.excite(0.004, 0.05)
    controller.sticks[0], controller.mode = 0.3 * flies, chosen
    line.excite(5.0, 0.05)
    assert controller.mode == chosen
    assert line.aircraft.at_rest


def test_a_pilot_who_leaves_system_id_by_his_switch_has_ended_the_schedule(flying):
    """The excitation node ends it where the bridge refuses; its next chirp would enter again."""
    line = flying('ardupilot')
    line.segment(signal='chirp', injection='control', **CHIRP)
    line.excite(4.0, 0.05)
    assert line.controller.mode == flown.SYSTEM_ID
    line.controller.mode = 2  # AltHold
    line.excite(2.0, 0.05)
    assert 'left by the pilot' in line.connected.aircraft.cannot(Ability.EXCITE)
    assert line.cycles[-1].flags & f.Flag.EXCITATION_REFUSED
    assert line.aircraft.at_rest


@pytest.mark.parametrize('wait_s', [0.0, 0.4])
def test_system_id_is_not_entered_over_the_mode_that_the_pilot_chooses_meanwhile(flying, wait_s):
    """While its parameters are written, and while the mode is asked for; by switch, no stick."""
    line, asked = flying('ardupilot'), []
    controller, sid = line.controller, line.aircraft.system_id
    before = dict(controller.parameters)
    controller._set_mode = lambda message: asked.append(message.param2) or flown.DENIED
    line.segment(signal='chirp', injection='control', axis='pitch', **CHIRP)
    line.excite(wait_s, 0.05)
    assert sid.phase.value == ('writing SID parameters' if not wait_s else 'asking for the mode')
    controller.mode = line.aircraft.flight.mode = flown.LOITER  # as its next heartbeat says
    asked.clear()
    line.excite(4.0, 0.05)
    assert asked == []
    assert sid.refusal == 'the pilot has chosen another mode'
    assert controller.parameters == before


@pytest.mark.parametrize(('kind', 'name', 'values'), [
    ('ardupilot', 'GUID_OPTIONS', {
        12: 'is 12: with its bit 3 no climb is half throttle; set it to 4',
        None: 'GUID_OPTIONS is not read', 4: ''}),
    ('px4', 'COM_OBL_RC_ACT', {0: '', 7: None, None: None}),
    ('ardupilot', 'GUID_TIMEOUT', {3.0: '', 5.0: None, None: None})])
def test_the_check_shows_what_forbids_an_excitation_or_a_bridge_that_dies(
        flying, kind, name, values):
    line = flying(kind)
    for value, words in values.items():
        line.aircraft.gains.values.pop(name, None)
        if value is not None:
            line.controller.parameters[name] = value
            line.hear(line.controller.pack(line.controller.value(name)))
        screen = lines(report(line.aircraft, line.link, line.now_ns, ''))
        row = next(row for row in screen if name in row)
        assert row.startswith('  ok' if words == '' else '  --')
        if name == 'GUID_OPTIONS':
            line.segment()
            refusal = line.connected.aircraft.cannot(Ability.EXCITE)
            assert words in refusal
            assert bool(words) == bool(refusal)


@pytest.mark.parametrize('begins_with', ['position', 'pressure'])
def test_px4_whose_height_comes_from_elsewhere_flies_at_its_hover_throttle(flying, begins_with):
    """A position's height is not a barometer's. Without a position PX4 refuses Position mode."""
    aircraft = Flying(KINDS['px4'])
    set_rate, set_mode = aircraft.set_rate, aircraft._set_mode

    def lose_position():
        aircraft.streams.pop('LOCAL_POSITION_NED', None)
        aircraft.set_rate = lambda name, hz: (
            None if name == 'LOCAL_POSITION_NED' else set_rate(name, hz))

    if begins_with == 'pressure':
        lose_position()
    line = flying('px4', aircraft=aircraft)
    line.segment(injection='rate')
    line.excite(4.0, 0.05)
    assert aircraft.mode == flown.OFFBOARD
    hover = aircraft.craft.hover_throttle
    if begins_with == 'pressure':
        set_rate('LOCAL_POSITION_NED', 25.0)
    else:
        lose_position()
        aircraft._set_mode = lambda m: flown.DENIED if m.param2 == 3.0 else set_mode(m)
        aircraft.pilot_mode = 2 << 16  # Altitude: its own choice at a loss of OFFBOARD
    for _ in range(1650):
        line.excite(0.004, 0.05)
        assert aircraft.target.thrust == pytest.approx(hover, abs=0.03)
    assert 'is not known any more' in line.connected.aircraft.cannot(Ability.EXCITE)
    assert aircraft.now_s - aircraft.targets[-1] > 1.0
    assert aircraft.mode == aircraft.pilot_mode
    assert line.aircraft.takeover.phase.value == 'idle'
    assert abs(aircraft.craft.machine.state[POSITION + 2]) < 1.0
    if begins_with == 'position':  # what it followed until it noticed: attitude, level
        assert aircraft.target.type_mask & 7 == 7
        assert angles_of(aircraft.target.q)[:2] == pytest.approx((0.0, 0.0), abs=1e-6)


NOW_S = 100.0
HOVER = {'mode': flown.POSITION_MODE, 'armed': True, 'landed': 2, 'angles': (0.1, -0.1, 1.0),
         'sticks': (0.1, 0.0, -0.2, 0.0), 'volts': 12.5, 'height_m': 3.0,
         'height_source': 'the barometer', 'height_s': NOW_S,
         'place': (1.0, 2.0, -3.0), 'volts_s': NOW_S, 'attitude_s': NOW_S, 'beat_s': NOW_S,
         'sticks_s': NOW_S, 'calm_since_s': NOW_S - 2.0}


@pytest.mark.parametrize(('changed', 'words'), [
    ({'sticks': (0.1, 0.0, -0.2, 0.16)}, 'sticks were moved'),
    ({'sticks': (-0.04, 0.14, -0.34, 0.14)}, ''), ({'sticks': (0.0, 0.0)}, 'not received'),
    ({'sticks_s': NOW_S - 1.1}, 'not received'), ({'sticks_s': NOW_S - 0.9}, ''),
    ({'failsafe': True}, 'in failsafe'), ({'armed': False}, 'disarmed'),
    ({'angles': (0.62, 0.0, 0.0)}, 'beyond 35'), ({'angles': (0.0, -0.62, 0.0)}, 'beyond 35'),
    ({'angles': (0.6, -0.6, 3.0)}, ''),
    ({'height_m': 5.1}, r'\+2.1 m of height'), ({'height_m': 0.9}, '-2.1 m of height'),
    ({'height_m': 4.9}, ''), ({'height_m': 1.1}, ''), ({'height_m': None}, ''),
    ({'height_s': NOW_S - 1.1}, 'by the barometer is not known'), ({'height_s': NOW_S - 0.9}, ''),
    ({'height_source': 'LOCAL_POSITION_NED'}, 'by the barometer is not known'),
    ({'place': (5.0, 5.1, -3.0)}, '5.1 m from where'), ({'place': (-2.5, -1.5, 9.0)}, ''),
    ({'volts': 11.49}, 'battery has sunk to 11.5'), ({'volts': 11.51}, ''),
    ({'volts_s': NOW_S - 5.1}, 'not reported any more'), ({'volts_s': NOW_S - 4.9}, ''),
    ({'attitude_s': NOW_S - 0.31}, 'stale: no attitude'), ({'attitude_s': NOW_S - 0.29}, ''),
    ({'beat_s': NOW_S - 2.6}, 'stale: no heartbeat'), ({'beat_s': NOW_S - 2.4}, ''),
])  # fmt: skip
def test_what_ends_an_excitation(changed, words):
    fault = Guard.of(FlightState(**HOVER)).fault(FlightState(**{**HOVER, **changed}), NOW_S)
    assert re.search(words, fault)
    assert bool(fault) == bool(words)


@pytest.mark.parametrize(('injection', 'most_deg'), [
    (f.Injection.ATTITUDE, 20.0 + 8.0), (f.Injection.RATE, 200.0 + 5.0 * 8.0)])
def test_what_is_sent_stays_within_its_limits(injection, most_deg):
    """Of the excitation, and of the lean of 8 deg by which it goes back to its place."""
    flight = FlightState(**{**HOVER, 'angles': (0.0, 0.0, 1.0), 'speed': (0.0, 0.0, 0.0),
                            'place_s': NOW_S})  # fmt: skip
    flown_by = Takeover(BY_NUMBER[3].means, flight, dict)
    flown_by.begin(0, injection, NOW_S)
    flight.mode, flight.place, flight.speed = flown.GUIDED_NOGPS, (4.9, 2.0, -3.0), (2.0, 0.0, 0.0)
    flown_by.poll(NOW_S)
    flown_by.excite(9.0, NOW_S)
    (sent,) = flown_by.poll(NOW_S + 0.02)
    sends = sent.rates if injection is f.Injection.RATE else angles_of(sent.q)
    assert math.degrees(sends[0]) == pytest.approx(most_deg)
    assert math.degrees(angles_of(sent.q)[1]) == pytest.approx(8.0)


def test_the_mode_goes_back_where_the_line_breaks_just_when_it_was_asked_for():
    """ArduPilot stays in it without set-points. This one answers no question for its mode, so that
    each heartbeat that comes by itself allows one command.
    """
    means, asked, broken_s = BY_NUMBER[3].means, [], 0.0
    flight = FlightState(**{**HOVER, 'mode': flown.LOITER})
    mode, flown_by = flown.LOITER, Takeover(means, flight, dict)
    flown_by.begin(0, f.Injection.ATTITUDE, NOW_S)
    for k in range(600):
        now_s = NOW_S + 0.02 * k
        if now_s - broken_s > 5.0:
            flight.attitude_s = flight.sticks_s = flight.height_s = now_s
            if k % 50 == 0:
                flight.mode, flight.beat_s = mode, now_s
        flown_by.excite(0.0, now_s)
        for frame in flown_by.poll(now_s):
            if isinstance(frame, f.Command) and frame.command == flown.DO_SET_MODE:
                mode, broken_s = int(frame.parameters[1]), broken_s or now_s
                asked.append(mode)
    assert asked == [flown.GUIDED_NOGPS, flown.LOITER]
    assert flown_by.phase.value == 'idle'


CALM = Inertial(0, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(('changed', 'moving', 'words'), [
    ({}, {}, ''), ({'armed': False}, {}, 'not armed'), ({'landed': 1}, {}, 'not in the air'),
    ({'landed': 0}, {}, 'does not say that it flies'),
    ({}, {'attitude': (0.0, -0.22, 0.0)}, 'does not hover'),
    ({}, {'attitude': (0.2, 0.2, 2.0)}, ''), ({}, {'gyro': (0.0, 0.0, 0.8)}, 'does not hover'),
    ({}, {'gyro': (0.7, -0.7, 0.7)}, ''), ({'climb_m_s': -0.61}, {}, 'does not hover'),
    ({'climb_m_s': 0.59}, {}, ''),
    ({'speed': (1.1, -1.1, 0.0)}, {}, 'does not hover'), ({'speed': (1.0, 1.0, 9.0)}, {}, ''),
])  # fmt: skip
def test_what_counts_as_hover(changed, moving, words):
    """Calm for two seconds: the one before the last is not, and not yet at 1.9 s."""
    flight = FlightState(**{**HOVER, 'calm_since_s': math.inf, **changed})
    for k in range(21):
        flight.inertial(replace(CALM, **(moving if k == 10 else {})), NOW_S + 0.1 * k)
        assert flight.hover_fault(NOW_S + 0.1 * k) or k == 20
    found = flight.hover_fault(NOW_S + 2.001)
    assert words in found
    assert bool(found) == bool(words)


@both
def test_nothing_begins_without_hover_pilots_mode_fresh_line_and_allow(flying, name):
    def refuses(words):
        line.controller.written.clear()
        line.controller.target, mode = None, line.controller.mode
        with pytest.raises(RefusedError, match=words):
            line.ask(roll_rate_kp=0.05)
        line.segment()
        assert words in line.connected.aircraft.cannot(Ability.EXCITE)
        line.excite(1.6, 0.1)
        assert not line.controller.written
        assert line.controller.mode == mode
        assert line.controller.target is None

    line = flying(name, gains=False, excitation=False)
    refuses('is off: read docs/')
    with pytest.raises(RefusedError, match='gains is off'):  # nor does a rollback write any
        line.updates.ask({'roll.rate.kp': 0.05, 'rollback': True}, 1e-9 * line.now_ns)
    line.allow = (True, True)
    line.connect(Link())
    line.fly(4.5)
    assert line.connected.aircraft.cannot(Ability.GAINS) == ''
    if name == 'px4':
        line.controller.mode = 4 << 16
        line.fly(1.3)
        refuses('the pilot must fly')
    else:
        line.controller.take_off()
        line.fly(0.3)
        refuses('not in the air')


@both
def test_a_segment_in_flight_ends_and_the_mode_is_given_back(flying, name):
    """By the guard, and the mode that the pilot has chosen stays; PX4's also by silence.

    ArduPilot is excited by rates, of pitch: stale fields beside them do no harm.
    """
    line, rates = flying(name), {'injection': 'rate', 'axis': 'pitch'}
    controller, own = line.controller, flown.OFFBOARD if name == 'px4' else flown.GUIDED_NOGPS
    chosen = flown.STABILIZED if name == 'px4' else flown.LOITER
    for case, words in (('mode', 'was left by'), ('sticks', 'sticks were moved'),
                        ('silence', 'has been silent'))[: 3 if name == 'px4' else 2]:
        if case != 'mode':  # after another one
            controller.sticks[1] = 0.0
            controller.take_off()
            line.relay.segment({'segment': 'idle', 'signal': 'none'})
            line.fly(4.0)
        line.segment(**(rates if name == 'ardupilot' else {}))
        line.excite(3.2, 0.3 if name == 'ardupilot' else 0.05)
        assert controller.mode == own, case
        if name == 'ardupilot':
            assert max(abs(c.excitation[1]) for c in line.cycles) == pytest.approx(0.3, abs=0.02)
            assert max(map(abs, controller.angles[:2])) < 0.3
        if case == 'mode':
            controller.mode = chosen
        elif case == 'sticks':
            controller.sticks[1] = 0.4
        for _ in range(400):
            if case != 'silence':
                line.relay.setpoint(0.05, 0.05, 0.0, 1e-9 * line.now_ns)
            line.run()
        assert controller.mode == (chosen if case == 'mode' else controller.pilot_mode), case
        assert words in line.connected.aircraft.cannot(Ability.EXCITE)
        assert line.cycles[-1].flags & f.Flag.EXCITATION_REFUSED


def test_a_wrong_chirp_is_refused_in_one_line():
    for given, words in (
        ({'amplitude': 0.9}, 'SID_MAGNITUDE must be at most 0.25'),
        ({'sweep_s': 6.0}, 'too short for SYSTEM ID'),
        ({'sweep_s': 24.0, 'f0_hz': 0.2}, 'and 10.5 s must be left of 24'),  # as its steady start
        ({'f0_hz': math.nan}, 'needs f0_hz'),
    ):
        with pytest.raises(ValueError, match=words):
            sid_parameters(0, f.Injection.CONTROL, {**CHIRP, **given})
    given = sid_parameters(2, f.Injection.ATTITUDE, CHIRP)
    assert (given['SID_AXIS'], given['SID_MAGNITUDE']) == (3, math.degrees(0.05))


@both
def test_one_screen_says_whether_it_is_ready_and_what_to_change(flying, name):
    line = flying(name)
    log = 'SDLOG_PROFILE' if name == 'px4' else 'LOG_BITMASK'
    line.aircraft.gains.values[log] = 1.0
    screen = lines(report(line.aircraft, line.link, line.now_ns, 'an X frame'))
    assert len(screen) <= 25
    assert screen[0] == f'  ok  {"PX4 1.16" if name == "px4" else "ArduPilot 4.6"}, an X frame'
    bad = [row for row in screen if row.startswith('  --')]
    assert any(row.startswith(f'  --  log {log} 1: set {log} to') for row in bad)
    assert any('Hz: below 100 Hz identify from the log' in row for row in bad)
    assert screen[-1] == f'{len(bad)} of {len(screen) - 1} lines are not as they should be'


def test_the_check_listens_at_a_port_where_somebody_is(tmp_path, refused, capsys):
    words = ['--check', '--port', str(tmp_path / 'tty'), '--seconds']
    assert 'port not there: plug it in' in refused(check, *words, 0.1)
    with Port(FlightController(), Pty(tmp_path / 'tty')):
        assert "an STM32 with this project's firmware needs no --check" in refused(
            check, *words, 0.3)
    with Port(Flying(KINDS['px4']), Pty(tmp_path / 'tty')):
        assert check([*words, '3']) == 3
    screen = capsys.readouterr().out
    assert screen.startswith("  ok  PX4 1.16, PX4's CA_ROTOR parameters")
    assert '  ok  mode ' in screen
    assert 'leads to another computer' in refused(check, '--port', 'udp://10.0.0.1:14550')


def test_a_slow_line_gets_what_it_can_carry():
    wanted = {'HIGHRES_IMU': 250.0, 'ATTITUDE': 250.0, 'SERVO_OUTPUT_RAW': 250.0,
              'ATTITUDE_TARGET': 50.0, 'RC_CHANNELS': 50.0}
    assert fitted(wanted, math.inf) == wanted
    rates = fitted(wanted, 0.8 * 5760)
    assert load(rates) <= 0.8 * 5760
    assert min(rates.values()) >= 10.0
