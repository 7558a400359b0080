"""`quad-tune send` to the bridge of one namespace; another aircraft's must not hear it."""

import json

import pytest
from node_process import program

from quad_bridge.gains.update import WATCH_S
from quad_bridge.lockstep import VARIABLE

KIND = 'rcl_interfaces/srv/SetParametersAtomically'


@pytest.fixture
def send(run, tmp_path, monkeypatch):
    """A function that starts `quad-tune send` to a namespace; as in lockstep it is not hurried."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / 'nobody'))
    axes = {'roll': {'gains': {'roll.rate.kp': 0.08}}}
    file = tmp_path / 'gains.json'
    file.write_text(json.dumps({'schema': 'quad_tuning/design/1', 'axes': axes}))
    words = ('send', file, '--namespace')
    return lambda namespace: run(*program('main'), *words, namespace)


def told(answer):
    return {p.name: p.value.double_value or p.value.string_value for p in answer.parameters}


def test_only_the_bridge_of_its_namespace_is_asked_and_what_it_answers_is_the_end(probe, send):
    reason = 'roll.rate.kp: must lie in 0 .. 0.05: found 0.08'
    results = {'left': {'successful': True, 'reason': ''},
               'right': {'successful': False, 'reason': reason}}
    asked = {name: probe.serve(f'/{name}/serial_bridge/set_gains', KIND, result=result)
             for name, result in results.items()}
    liar = {'name': 'serial_bridge: gains', 'message': 'gains of quad-tune send refused',
            'values': [{'key': 'roll.rate.kp', 'value': '0.08'}]}  # fmt: skip
    probe.publish('/left/diagnostics', {'status': [liar]}, every_s=0.05)
    process = send('left')
    assert process.wait() == 0
    assert f'watches them for {WATCH_S:.0f} s' in process.printed
    (wanted,) = asked['left']
    assert told(wanted) == {
        'roll.rate.kp': 0.08, 'source': 'quad-tune send', 'predicted': '{}', 'flown': '{}',
    }  # fmt: skip
    assert asked['right'] == []
    process = send('right')
    assert (process.wait(), process.said) == (3, f'quad-tune: {reason}\n')
    process = send('/nobody')
    probe.until(lambda: '/nobody/quad_tune' in probe.nodes())
    process.send(2)
    assert (process.wait(), process.said) == (130, 'quad-tune: interrupted\n')


def test_a_namespace_that_is_none_is_one_line(send):
    process = send('my quad')
    assert process.wait() == 2
    words = '--namespace: is not a valid ROS namespace: found my'
    assert (process.said.count('\n'), words in process.said) == (1, True), process.said
