"""What stands before a flight is estimated, kept, subtracted and can be had back; or refused."""

import numpy as np
import pytest
import yaml

from quad_bridge.errors import RefusedError
from quad_bridge.sensors.correction import Correction, as_sent, from_values
from quad_bridge.sensors.live import LiveSensors, Wanted
from quad_bridge.status import OK, WARN
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Flag

BIAS = (0.012, -0.02, 0.004)
"""rad/s, FLU."""
IRON = (12e-6, -30e-6, 5e-6)
START_S = 1.7e9
"""System time at which the STM32 started."""
ZERO = (0.0, 0.0, 0.0)


class Aircraft:
    """An STM32 that stands still with a biased gyro, its bridge's sensors, and its bag."""

    def __init__(self, folder, name='one', start_s=START_S, seed=7, **settings):
        self.sensors = LiveSensors(folder, **{'correct': True, **settings})
        self.name, self.start_s, self.cycle = name, start_s, 0
        self.rng = np.random.default_rng(seed)
        self.stamps, self.sent, self.published, self.told = [], [], [], []
        self.said = []
        self.shake = lambda _t: 0.0

    def run(self, seconds, *, armed=False):
        for _ in range(round(250 * seconds)):
            time_us = 4000 * self.cycle
            gyro = np.array(BIAS) + 0.005 * self.rng.standard_normal(3)
            gyro[1] += self.shake(1e-6 * time_us)
            felt = np.array([0.0, 0.0, 9.80665]) + 0.05 * self.rng.standard_normal(3)
            frame = Cycle(
                time_us, self.cycle, flip_body(gyro), flip_body(felt), ZERO, ZERO, ZERO,
                (0.0,) * 4, ZERO, (0.0,) * 4, int(Flag.ARMED if armed else Flag.NONE),
            )  # fmt: skip
            self.sensors.cycle(frame, self.start_s + 1e-6 * time_us)
            self._publish(frame, round(1e9 * self.start_s) + 1000 * time_us)
            if self.cycle % 12 == 0:
                self.tick()
            self.cycle += 1

    def tick(self):
        self.sensors.aircraft(self.name)
        wanted = self.sensors.wanted()
        if wanted is not None:
            self.ask(wanted)
        self.told.append(from_values(self.sensors.status().values))

    def ask(self, wanted):
        try:
            self.said.append(self.sensors.estimate(wanted))
        except RefusedError as error:
            self.said.append(str(error))

    def _publish(self, frame, stamp_ns):
        sent, bias = flip_body(frame.gyro), self.sensors.stamped(stamp_ns).gyro_bias
        self.stamps.append(stamp_ns)
        self.sent.append(sent)
        self.published.append(tuple(a - b for a, b in zip(sent, bias, strict=True)))

    def stand(self, seconds=7.0, then_armed=0.1):
        """Stand still, then arm."""
        self.run(seconds)
        self.run(then_armed, armed=True)
        return self

    def kept(self):
        """What the aircraft's file has of the rest."""
        return yaml.safe_load(self.sensors.path.read_text())['sensors']['rest']

    @property
    def status(self):
        return self.sensors.status()


def test_before_it_arms_the_bias_is_estimated_kept_and_subtracted(tmp_path):
    one = Aircraft(tmp_path).stand(8.0, 3.0)
    (said,) = one.said
    assert 'at rest, arming' in said
    flown = np.array(one.published[-500:])
    # 6 s of 0.005 rad/s: a standard error of 1.3e-4 rad/s, 2.2e-4 of the 2 s compared
    assert flown.mean(axis=0) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert one.kept()['gyro_bias'] == pytest.approx(BIAS, abs=6e-4)
    assert one.kept()['source'] == 'the bridge, arming'
    assert (one.status.level, one.status.message) == (OK, said)


def test_what_was_sent_can_be_had_back_from_what_is_published(tmp_path):
    one = Aircraft(tmp_path).stand(7.0, 1.0).stand(7.0, 1.0)
    assert len({c.since_ns for c in one.told}) == 3  # none, and two estimates
    back = as_sent(np.array(one.stamps), np.array(one.published), one.told, 'gyro_bias')
    assert np.abs(back - np.array(one.sent)).max() < 1e-15
    assert np.abs(np.array(one.published) - np.array(one.sent)).max() > 0.01
    assert one.kept()['before']['gyro_bias'] == pytest.approx(BIAS, abs=6e-4)


def test_nothing_told_means_nothing_subtracted():
    assert from_values({'unrelated': '1'}) is None
    assert from_values({**Correction().told(), 'removed since (ns)': 'soon'}) is None
    found = as_sent(np.arange(3), np.ones((3, 3)), [Correction(gyro_bias=BIAS)], 'gyro_bias')
    assert np.array_equal(found, np.ones((3, 3)))


def test_an_aircraft_that_moves_is_refused_and_the_earlier_estimate_stays(tmp_path):
    one = Aircraft(tmp_path).stand(7.0, 0.5)
    before = one.sensors.current
    one.shake = lambda t: 0.1 * np.sin(4.0 * t)
    one.stand(7.0, 0.5)
    assert 'not estimated (arming): it turns: ' in one.said[-1]
    assert one.said[-1].endswith('the earlier one stays')
    assert one.sensors.current == before
    assert (one.status.level, len(one.said)) == (WARN, 2)


def test_too_short_a_stand_is_told_without_a_warning(tmp_path):
    one = Aircraft(tmp_path).stand(1.0, 1.0)
    assert 'only 1.0 s of data' in one.status.message
    assert one.status.level == OK
    assert one.sensors.current == Correction()


def test_a_recording_wants_an_estimate_only_where_it_stands(tmp_path):
    one = Aircraft(tmp_path)
    one.run(7.0)
    one.sensors.want('recording')
    one.run(0.1)
    assert 'at rest, recording' in one.said[0]
    one.run(7.0, armed=True)
    one.sensors.want('recording')
    one.run(0.1, armed=True)
    assert len(one.said) == 2  # the second is of the arming
    one.ask(Wanted('asked for', one.sensors.standing()))
    assert 'it is armed' in one.said[-1]


def aircraft_file(tmp_path, text):
    (tmp_path / 'one').mkdir()
    file = tmp_path / 'one' / 'sensors.yaml'
    file.write_text(text)
    return file


def test_a_restart_of_the_stm32_forgets_its_bias_and_keeps_the_compass(tmp_path):
    file = aircraft_file(tmp_path, f'sensors: {{compass: {{offset: {list(IRON)}}}}}\n')
    one = Aircraft(tmp_path).stand()
    assert one.sensors.current.gyro_bias != ZERO
    one.sensors.restarted()
    one.run(0.1, armed=True)
    assert (one.sensors.current.gyro_bias, one.sensors.current.hard_iron) == (ZERO, IRON)
    assert 'not estimated since' in one.status.message
    compass = yaml.safe_load(file.read_text())['sensors']['compass']
    assert [float(v) for v in compass['offset']] == list(IRON)


@pytest.mark.parametrize(('later_s', 'resumed'), [(0.3, True), (60.0, False)])
def test_another_bridge_takes_the_bias_of_this_power_up_only(tmp_path, later_s, resumed):
    first = Aircraft(tmp_path).stand()
    second = Aircraft(tmp_path, start_s=START_S + later_s)
    second.cycle = first.cycle
    second.run(1.0, armed=True)
    bias = first.sensors.current.gyro_bias if resumed else ZERO
    assert second.sensors.current.gyro_bias == bias


def test_an_estimate_before_the_aircraft_is_known_is_kept_once_it_is(tmp_path):
    one = Aircraft(tmp_path, name='').stand()
    assert one.sensors.path is None
    assert one.status.values['kept in'] == 'nowhere: the aircraft is not known'
    one.name = 'late'
    one.run(0.1, armed=True)
    assert one.sensors.path == tmp_path / 'late' / 'sensors.yaml'
    assert one.kept()['gyro_bias'] == pytest.approx(BIAS, abs=6e-4)


@pytest.mark.parametrize(
    ('text', 'fault'),
    [
        ('sensors: [', 'cannot be read'),
        ('sensors: {compass: {offset: [1, 2]}}', 'compass: offset: must be three numbers'),
        ('sensors: {compass: {offset: [1, 2, .nan]}}', 'offset: must be within ±0.001 (SI'),
        ('sensors: {compass: {offset: [20.0, -3.0, 5.0]}}', 'must be within ±0.001 (SI units)'),
        ('sensors: {compass: {offset: "123"}}', 'must be three numbers: found'),
        ('sensors: {compass: {offset: [true, 0, 0]}}', 'must be three numbers: found'),
        (f'sensors: {{compass: {{offset: [{10**400}, 0, 0]}}}}', 'must be three numbers: found'),
        ('[' * 700, 'cannot be read'),
        ('sensors: {rest: [1], compass: {offset: [1, 2]}}', 'must be three numbers'),
    ],
    ids=range(9),
)
def test_a_spoilt_file_is_told_and_left_alone(tmp_path, text, fault):
    file = aircraft_file(tmp_path, text)
    one = Aircraft(tmp_path).stand(5.5)
    assert one.status.level == WARN
    assert str(file) in one.status.message
    assert fault in one.status.message
    assert one.sensors.current.hard_iron == ZERO
    assert one.sensors.current.gyro_bias == pytest.approx(BIAS, abs=6e-4)
    if 'offset' not in text:
        assert file.read_text() == text


def test_where_it_may_not_correct_it_only_keeps(tmp_path):
    one = Aircraft(tmp_path, correct=False).stand()
    assert one.published == one.sent
    assert one.sensors.path.exists()
