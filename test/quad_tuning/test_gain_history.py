"""`quad-tune history` and `quad-tune rollback` on the lines that the bridge writes."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest

from quad_bridge.gains.gate import GainRequest
from quad_bridge.gains.history import History
from quad_sysid.errors import BadInputError
from quad_tuning.cli import main
from quad_tuning.history import STORED, read_design, read_history, send, way_back

KP, ANGLE = 'roll.rate.kp', 'roll.angle.kp'


def gains(kp, angle):
    return {KP: kp, ANGLE: angle, 'loop.rate_hz': 250.0}


@pytest.fixture
def folder(tmp_path):
    """Found, one good update in two steps, one that was taken back."""
    log = History(tmp_path, lambda job: job())
    log.open('quad_7')
    log.note_active(gains(0.07, 3.0))
    asked = GainRequest({}, source='identification of flight_1', bag='flight_1')
    log.write('active', gains(0.1, 6.0), asked, update='a')
    log.write('active', gains(0.1, 7.0), asked, update='a')
    log.write('confirmed', None, asked, update='a')
    asked = GainRequest({}, source='operator')
    log.write('active', gains(0.2, 7.0), asked, update='b')
    log.write('rolled back', None, asked, update='b', reason='roll: oscillation')
    log.note_active(gains(0.1, 7.0))
    return tmp_path


def test_every_set_stands_there_with_its_source_and_outcome(folder, printed):
    sets = json.loads(printed(main, 'history', '--folder', folder, '--json'))['sets']
    assert [one['outcome'] for one in sets] == [
        'found', 'passed', 'confirmed', 'rolled back', 'found',
    ]  # fmt: skip
    assert [one['gains'][ANGLE] for one in sets] == [3.0, 6.0, 7.0, 7.0, 7.0]
    assert (sets[2]['bag'], sets[3]['reason']) == ('flight_1', 'roll: oscillation')
    table = printed(main, 'history', '--folder', folder)
    assert table.startswith(f'{folder}/quad_7/gains.jsonl\n')
    assert 'rolled back  operator' in table
    assert 'roll.rate.kp 0.2' in table
    assert 'loop.rate_hz' not in table


def test_an_update_that_the_bridge_did_not_survive_is_unfinished(folder):
    log = History(folder, lambda job: job())
    log.open('quad_7')
    asked = GainRequest({}, source='operator')
    log.write('active', gains(0.12, 7.0), asked, update='c')
    log.write('active', gains(0.14, 7.0), asked, update='c')
    sets = read_history(folder / 'quad_7' / 'gains.jsonl')
    assert [one.outcome for one in sets[5:]] == ['in flight', 'in flight']
    log.note_active(gains(0.1, 7.0))
    sets = read_history(folder / 'quad_7' / 'gains.jsonl')
    assert [one.outcome for one in sets[5:]] == ['unfinished', 'unfinished', 'found']
    log.write('rolled back', None, asked, update='c')  # only the link had been away
    sets = read_history(folder / 'quad_7' / 'gains.jsonl')
    assert [one.outcome for one in sets[5:]] == ['rolled back', 'rolled back', 'found']


def test_the_way_back_leads_to_the_last_good_set_that_differs(folder):
    sets = read_history(folder / 'quad_7' / 'gains.jsonl')
    chosen, difference = way_back(sets)
    assert (chosen.number, difference) == (1, {KP: 0.07, ANGLE: 3.0})
    assert way_back(sets, 4)[1] == {KP: 0.2}
    assert way_back(sets[:4])[1] == {KP: 0.1}
    set_up = replace(sets[-1], number=6, gains={**sets[-1].gains, 'accel.offset_x': 0.1})
    earlier = [replace(one, gains={**one.gains, 'accel.offset_x': 0.0}) for one in sets]
    assert way_back([*earlier, set_up]) == (earlier[0], {KP: 0.07, ANGLE: 3.0})
    limited = [replace(one, gains={**one.gains, 'roll.rate.output_limit': limit})
               for one, limit in zip(sets, (0.3, 0.3, 0.3, 0.2, 0.2), strict=True)]
    assert way_back(limited, 1)[1] == {KP: 0.07, ANGLE: 3.0, 'roll.rate.output_limit': 0.3}
    with pytest.raises(BadInputError, match=r'must be 1\.\.5'):
        way_back(sets, 9)
    with pytest.raises(BadInputError, match='no earlier good set'):
        way_back(sets[:1])


def test_a_set_confirmed_on_the_ground_is_good_once_it_has_flown(folder):
    path = folder / 'quad_7' / 'gains.jsonl'
    log = History(folder, lambda job: job())
    log.open('quad_7')
    asked = GainRequest({}, source='operator')
    for kp in (0.08, 0.09):
        log.write('active', gains(kp, 8.0), asked, update='c')
    log.write('confirmed', None, asked, update='c', flown=False)
    log.open('another')
    log.open('quad_7')
    log.note_active(gains(0.09, 8.0))  # after the bridge has started again
    log.write('active', gains(0.3, 8.0), asked, update='d')
    sets = read_history(path)
    assert [one.outcome for one in sets[5:]] == ['passed', 'not flown', 'not flown', 'in flight']
    assert way_back(sets)[1] == {KP: 0.1, ANGLE: 7.0}
    log.note_active(gains(0.09, 8.0))
    log.write('flown')
    log.write('active', gains(0.2, 8.0), asked, update='e')
    assert way_back(read_history(path))[1] == {KP: 0.09}


def test_the_rollback_shows_what_it_would_send_and_needs_ros_to_send_it(
    folder, monkeypatch, printed, refused
):
    monkeypatch.delitem(sys.modules, 'quad_tuning.update_node', raising=False)
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    said = printed(main, 'rollback', '--folder', folder, '--print')
    assert said.startswith('set 1 of')
    assert said.endswith('roll.rate.kp 0.07, roll.angle.kp 3\n')
    told = refused(main, 'rollback', '--folder', folder)
    assert 'quad-tune rollback: needs ROS 2 (rclpy is missing); run it' in told


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (['--folder', 'nowhere'], 'holds no history of gains'),
        (['--aircraft', 'quad_9'], 'quad_7, quad_8: found quad_9'),
        ([], 'holds several aircraft: found quad_7, quad_8; choose one by --aircraft'),
        (['--aircraft', 'quad_8'], f'schema must be {STORED}: found other'),
    ],
)
def test_bad_input_is_one_line_and_status_2(folder, options, words, refused):
    (folder / 'quad_8').mkdir()
    (folder / 'quad_8' / 'gains.jsonl').write_text('{"schema": "other"}\n')
    given = options if '--folder' in options else ['--folder', folder, *options]
    assert words in refused(main, 'history', *given)


@pytest.mark.parametrize(('schema', 'figures'), [
    ('quad_tuning/design/1', 'figures'), ('quad_sysid/report/1', 'gain_figures'),
])
def test_what_is_sent_says_from_which_gains_the_design_began(tmp_path, schema, figures):
    path = tmp_path / 'file.json'
    said = {'peak': 1.2, f'{KP}_before': 0.07, 'rise_time_s': 0.1, 'rise_time_s_before': 0.2}
    path.write_text(json.dumps(
        {'schema': schema, 'axes': {'roll': {'gains': {KP: 0.1}, figures: said}}}))
    wanted, beside = read_design(path)
    assert wanted == {KP: 0.1}
    assert json.loads(beside['predicted']) == {'roll.peak': 1.2}
    assert json.loads(beside['flown']) == {KP: 0.07}


@pytest.mark.parametrize(('answer', 'status', 'out', 'err'), [
    ((True, ''), 0, 'active: roll.rate.kp 0.1; the bridge watches', ''),
    ((True, 'step 1 of 2 is in force'), 0, 'step 1 of 2 is in force\n', ''),
    ((False, 'no link'), 3, '', 'quad-tune: no link\n')])
def test_what_is_refused_is_an_error_and_the_first_of_several_steps_is_none(
        tmp_path, monkeypatch, capsys, answer, status, out, err):
    path = tmp_path / 'gains.json'
    path.write_text(json.dumps({'schema': 'quad_tuning/design/1',
                                'axes': {'roll': {'gains': {KP: 0.1}}}}))
    monkeypatch.setattr('quad_tuning.history._publish', lambda _: lambda *_, **__: answer)
    assert send(SimpleNamespace(design=path, namespace='')) == status
    said = capsys.readouterr()
    assert (said.out.startswith(out), bool(said.out), said.err) == (True, bool(out), err)


def test_who_interrupts_send_hears_that_the_bridge_goes_on(tmp_path, monkeypatch, capsys):
    def publish(*_, **__):
        raise KeyboardInterrupt('the bridge goes on')

    path = tmp_path / 'gains.json'
    path.write_text(json.dumps({'schema': 'quad_tuning/design/1',
                                'axes': {'roll': {'gains': {KP: 0.1}}}}))
    monkeypatch.setattr('quad_tuning.history._publish', lambda _: publish)
    with pytest.raises(KeyboardInterrupt):
        send(SimpleNamespace(design=path, namespace=''))
    assert capsys.readouterr().err == 'quad-tune: the bridge goes on\n'
