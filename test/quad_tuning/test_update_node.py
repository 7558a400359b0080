"""`quad-tune send` to the bridge of one namespace; another aircraft's must not hear it."""

import json
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


def test_a_refusal_in_the_words_of_the_last_one_is_an_answer(probe, send):
    refusal = 'gains of quad-tune send refused: not while the excitation runs'
    asked = probe.listen('/left/gains/update')
    probe.publish('/left/diagnostics', gains_are(0.05, refusal, 1), every_s=0.05)
    process = send('left')
    probe.until(lambda: asked)
    probe.publish('/left/diagnostics', gains_are(0.05, refusal, 2), every_s=0.05)
    assert (process.wait(), process.said) == (3, f'quad-tune: {refusal}\n')


@pytest.mark.parametrize('taken', [True, False])
def test_gains_that_were_active_before_are_no_answer(probe, send, taken):
    """The bridge, whose link is down, still reports the set that it read last."""
    refusal = 'gains of quad-tune send refused: the link is down'
    asked = probe.listen('/left/gains/update')
    probe.publish('/left/diagnostics', gains_are(0.08, acknowledged=3), every_s=0.05)
    process = send('left')
    probe.until(lambda: asked)
    answer = gains_are(0.08, acknowledged=4) if taken else gains_are(0.08, refusal, 1, 3)
    probe.publish('/left/diagnostics', answer, every_s=0.05)
    expected = (0, '') if taken else (3, f'quad-tune: {refusal}\n')
    assert (process.wait(), process.said) == expected


@pytest.mark.parametrize('interrupted', [True, False])
def test_it_ends_in_one_line(probe, send, interrupted):
    process = send('/left' if interrupted else 'my quad')
    if interrupted:
        probe.until(lambda: '/left/quad_tune' in probe.nodes())
        process.send(2)
    assert process.wait() == (130 if interrupted else 2)
    words = 'interrupted' if interrupted else '--namespace: is not a valid ROS namespace: found my'
    assert (process.said.count('\n'), words in process.said) == (1, True), process.said
