"""`quad-tune send` to the bridge of one namespace; another aircraft's must not hear it."""

import json
import sys

import pytest

from quad_bridge.gains.update import WATCH_S
from quad_bridge.lockstep import VARIABLE

QUAD_TUNE = 'import sys; from quad_tuning.cli import main as start; sys.exit(start())'
KIND = 'rcl_interfaces/srv/SetParametersAtomically'


@pytest.fixture
def send(run, tmp_path, monkeypatch):
    """A function that starts `quad-tune send` to a namespace; as in lockstep it is not hurried."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / 'nobody'))
    axes = {'roll': {'gains': {'roll.rate.kp': 0.08}}}
    file = tmp_path / 'gains.json'
    file.write_text(json.dumps({'schema': 'quad_tuning/design/1', 'axes': axes}))
    words = ('send', file, '--namespace')
    return lambda namespace: run(sys.executable, '-c', QUAD_TUNE, *words, namespace)


def told(answer):
    """What a bridge was asked for."""
    return {p.name: p.value.double_value or p.value.string_value for p in answer.parameters}


@pytest.mark.parametrize('taken', [True, False])
def test_only_the_bridge_of_its_namespace_is_asked_and_what_it_answers_is_the_end(
    probe, send, taken
):
    """What anybody says in /diagnostics is no answer."""
    reason = '' if taken else 'roll.rate.kp: must lie in 0 .. 0.05: found 0.08'
    result = {'result': {'successful': taken, 'reason': reason}}
    asked = {
        name: probe.serve(f'/{name}/serial_bridge/set_gains', KIND, **result)
        for name in ('left', 'right')
    }
    liar = {'name': 'serial_bridge: gains', 'message': 'gains of quad-tune send refused',
            'values': [{'key': 'roll.rate.kp', 'value': '0.08'}]}  # fmt: skip
    probe.publish('/left/diagnostics', {'status': [liar]}, every_s=0.05)
    process = send('left')
    assert process.wait() == (0 if taken else 3)
    if taken:
        assert f'watches them for {WATCH_S:.0f} s' in process.printed
    else:
        assert process.said == f'quad-tune: {reason}\n'
    (wanted,) = asked['left']
    assert told(wanted) == {
        'roll.rate.kp': 0.08, 'source': 'quad-tune send', 'predicted': '{}', 'flown': '{}',
    }  # fmt: skip
    assert asked['right'] == []


@pytest.mark.parametrize('interrupted', [True, False])
def test_it_ends_in_one_line(probe, send, interrupted):
    process = send('/left' if interrupted else 'my quad')
    if interrupted:
        probe.until(lambda: '/left/quad_tune' in probe.nodes())
        process.send(2)
    assert process.wait() == (130 if interrupted else 2)
    words = 'interrupted' if interrupted else '--namespace: is not a valid ROS namespace: found my'
    assert (process.said.count('\n'), words in process.said) == (1, True), process.said
