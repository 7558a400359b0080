"""`quad-tune send` to the bridge of one namespace; another aircraft's must not hear it."""

import json
import signal
import sys

import pytest
from probe import content, event

from quad_bridge.gains.update import WATCH_S
from quad_bridge.lockstep import VARIABLE

QUAD_TUNE = 'import sys; from quad_tuning.cli import main; sys.exit(main())'


@pytest.fixture
def send(run, tmp_path, monkeypatch):
    """A function that starts `quad-tune send` to a namespace; as in lockstep it is not hurried."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / 'nobody'))
    axes = {'roll': {'gains': {'roll.rate.kp': 0.08}}}
    file = tmp_path / 'gains.json'
    file.write_text(json.dumps({'schema': 'quad_tuning/design/1', 'axes': axes}))
    words = ('send', file, '--namespace')
    return lambda namespace: run(sys.executable, '-c', QUAD_TUNE, *words, namespace)


def gains_are(kp, message='idle', refused=0, acknowledged=0):
    """The bridge's diagnostics."""
    told = {'roll.rate.kp': kp, 'refused': refused, 'writes acknowledged': acknowledged}
    values = [{'key': k, 'value': str(v)} for k, v in told.items()]
    return {'status': [{'name': 'serial_bridge: gains', 'message': message, 'values': values}]}


def test_gains_reach_the_bridge_of_their_namespace_only(probe, send):
    """Sets of earlier, which /gains/active tells a late subscriber first, are no answer."""
    asked = {name: probe.listen(f'/{name}/gains/update') for name in ('left', 'right')}
    for name in asked:
        probe.publish(f'/{name}/gains/active', event({'roll.rate.kp': 0.08}))
        probe.publish(f'/{name}/diagnostics', gains_are(0.05), every_s=0.05)
    process = send('/left')
    probe.until(lambda: asked['left'])
    assert content(asked['left'][0])['roll.rate.kp'] == 0.08
    assert process.poll() is None
    probe.publish('/left/diagnostics', gains_are(0.08, acknowledged=1), every_s=0.05)
    assert (process.wait(), process.said) == (0, '')
    assert f'watches them for {WATCH_S:.0f} s more' in process.printed
    assert (len(asked['left']), asked['right']) == (1, [])


NOT_NOW = 'gains of quad-tune send refused: not while the excitation runs'
DOWN = 'gains of quad-tune send refused: the link is down'


def test_an_answer_is_told_from_what_was_said_before(probe, send):
    """A refusal in the words of the last one, and gains that were active before.

    The bridge, whose link is down, still reports the set that it read last.
    """
    asked = probe.listen('/left/gains/update')
    for number, (before, after, status, said) in enumerate((
        (gains_are(0.05, NOT_NOW, 1), gains_are(0.05, NOT_NOW, 2), 3, NOT_NOW),
        (gains_are(0.08, acknowledged=3), gains_are(0.08, acknowledged=4), 0, ''),
        (gains_are(0.08, acknowledged=3), gains_are(0.08, DOWN, 1, 3), 3, DOWN),
    ), 1):
        probe.publish('/left/diagnostics', before, every_s=0.05)
        process = send('left')
        probe.until(lambda number=number: len(asked) == number)
        probe.publish('/left/diagnostics', after, every_s=0.05)
        assert (process.wait(), process.said) == (status, said and f'quad-tune: {said}\n')
    process = send('/left')  # of which the diagnostics say nothing new
    probe.until(lambda: '/left/quad_tune' in probe.nodes())
    process.send(signal.SIGINT)
    assert process.wait() == 130
    assert (process.said.count('\n'), 'interrupted' in process.said) == (1, True), process.said


def test_a_namespace_that_is_none_is_one_line(send):
    process = send('my quad')
    assert process.wait() == 2
    words = '--namespace: is not a valid ROS namespace: found my'
    assert (process.said.count('\n'), words in process.said) == (1, True), process.said
