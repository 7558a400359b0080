"""What is wrong with a node's arguments or parameters ends it with status 2 and one line."""

import os
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import pytest
from node_process import node_command, program

from quad_bridge import start as begins
from quad_bridge.topics import NODES

MADE = runpy.run_path(str(Path(__file__).parents[2] / 'tools/policies.py'))
ONE_OF = 'must be one of auto, manual, off: found'

PARAMETERS = [
    ('serial_bridge', {'baudd': 9600}, 'parameter baudd: is unknown; is it baud?'),
    ('monitor', {'validation_s': 5}, 'must be a number with a decimal point in 0 .. 600: found 5'),
    ('serial_bridge', {'bounds.roll.rate.kp': [2.0, 1.0]}, 'parameter bounds.roll.rate.kp'),
    ('serial_bridge', {'polarity': 'never'}, f"parameter polarity: {ONE_OF} 'never'"),
    ('serial_bridge', {'port': 'socket://10.0.0.1:1'}, 'make_key'),
    ('serial_bridge', {'port': 'udp://127.0.0.1'}, 'is written udp://HOST:PORT'),
    ('serial_bridge', {'robot_description': 'hexx'}, 'is neither a layout, nor a URDF'),
    ('bag_logger', {'topics': ['/nothing']}, 'is not a topic of this project: found /nothing'),
    ('bag_logger', {'reserve_mb': 1_000_000}, 'MB of free disk for a flight'),
    ('bag_logger', {'prefix': '../flight'}, 'prefix: must be a plain name'),
    ('excitation', {'schedule': '/nowhere.yaml'}, '/nowhere.yaml: cannot be read'),
    ('identification', {'train': '5:1'}, 'parameter train: needs two times START:END'),
]  # fmt: skip


@pytest.mark.parametrize(('name', 'parameters', 'words'), PARAMETERS)
def test_a_wrong_parameter(start, tmp_path, name, parameters, words):
    if name == 'bag_logger':
        parameters = {'folder': tmp_path / 'bags', 'autostart': True, **parameters}
    process = start(name, **parameters)
    assert process.wait() == 2
    assert process.said.startswith(f'{name}: ')
    assert (process.said.count('\n'), words in process.said) == (1, True), process.said
    assert not (tmp_path / 'bags').exists() or not list((tmp_path / 'bags').iterdir())


OUTSIDE = 'is unknown; parameters stand behind --ros-args: --ros-args -p NAME:=VALUE'


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--params-file', 'absent.yaml'], 'absent.yaml: cannot be read (No such file'),
        (['--params-file', 'broken.yaml'], 'Sequences can only be values'),
        (['-r', '__ns:=/2bad'], "'-r __ns:=/2bad'; write -r FROM:=TO"),
        (['-p', 'port:='], "'-p port:='; write -p NAME:=VALUE"),
        (['--log-level', 'loud'], 'does not use a valid severity level'),
        (['--nonsense'], "unknown argument: found ['--nonsense']"),
        (['--', 'every_s:=5'], f'argument every_s:=5: {OUTSIDE}'),
        (['--', '-p', 'every_s:=5'], f'argument -p: {OUTSIDE}'),
    ],
)
def test_a_wrong_argument_of_ros(start, run, tmp_path, arguments, words):
    del start
    (tmp_path / 'broken.yaml').write_text('bridge: [\n')
    process = run(*node_command('monitor'), *arguments, cwd=tmp_path)
    assert process.wait() == 2
    assert (process.said.count('\n'), words in process.said) == (1, True), process.said


def test_help_says_where_the_parameters_are(start, run):
    del start
    process = run(*program('monitor'), '--help')
    assert (process.wait(), process.said) == (0, '')
    assert process.printed.startswith('usage: monitor [--ros-args -p NAME:=VALUE')


@pytest.mark.parametrize(('wished', 'found'), [(None, 'LOCALHOST'), ('SUBNET', 'SUBNET')])
def test_nodes_are_found_on_this_computer_only_unless_that_is_wished(monkeypatch, wished, found):
    monkeypatch.setenv(begins.RANGE, wished or '')
    if wished is None:
        monkeypatch.delenv(begins.RANGE)
    monkeypatch.setenv(begins.PROFILES, 'the user has chosen')
    monkeypatch.setattr(begins, '_guard', lambda *_: None)
    said, begun = [], SimpleNamespace(main=lambda: said.append(os.environ[begins.RANGE]))
    monkeypatch.setattr(begins.importlib, 'import_module', lambda _: begun)
    begins.begin('a_node')
    assert said == [found]


SEND = ('import quad_tuning.update_node as node; node.LISTEN_S = 500.0; '
        "node.publish({'roll.rate.kp': 0.1}, 'test', namespace='alone')")
"""`quad-tune send`, which waits for a bridge."""


def allowed(name, space):
    """What the node's policy allows, as SROS2 reads it; `space`: in a namespace."""
    enclave = ET.parse(MADE['POLICIES']).find(f'.//enclave[@path="/{name}"]')
    found = {}
    for rules in enclave.find(f'.//profile[@node="{name}"]'):
        ((what, _),) = rules.items()
        found[what] = {
            one.text if one.text.startswith('/') else f'{space}/{one.text}'
            if not one.text.startswith('~') else f'{space}/{name}{one.text[1:]}' for one in rules
        }
    return found


def test_each_node_opens_what_its_policy_says(start, run, probe, tmp_path):
    assert MADE['POLICIES'].read_text() == MADE['policies'](), 'run tools/policies.py'
    for name in NODES:
        space = '/alone' if name == 'quad_tune' else ''
        own = {'folder': tmp_path, 'autostart': 'true'} if name == 'bag_logger' else {}
        own = {'port': tmp_path / 'none'} if name == 'serial_bridge' else own
        run(sys.executable, '-c', SEND) if space else start(name, **own)
        policy = allowed(name, space)
        wanted = {'publishes': policy['publish'], 'hears': policy['subscribe'],
                  'offers': policy['reply'], 'calls': policy.get('request', set())}  # fmt: skip

        def agrees(name=name, wanted=wanted, space=space):
            found = probe.opened(f'{space}/{name}')
            aside = {'/parameter_events', '/clock', f'{space}/{name}/get_type_description'}
            found = {what: names - aside for what, names in found.items()}
            return found == {what: names - aside for what, names in wanted.items()}

        probe.until(agrees, f'{name} opens {wanted}')
