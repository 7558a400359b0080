"""A node that meets bad bags says so in /diagnostics and goes on."""

import json
from collections import deque
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from flown_axis import SHORT, Axis, fly
from node_process import QUICKLY, Started
from probe import Probe, entries, event
from std_srvs.srv import Trigger

from quad_sysid.bags import write_bag
from quad_sysid.identification_node import IdentificationNode

OK, WARN, ERROR = 0, 1, 2
EACH_ONCE = f"""{QUICKLY}
import quad_sysid.identification_node as node
run, found = node.session.run, {{}}
def once(bags, out, wanted, progress):
    bag = node.Path(bags[0]).resolve()
    found[bag] = found[bag] if bag in found else run(bags, out, wanted, progress)
    return found[bag]
node.session.run = once
"""


@pytest.mark.timeout(1800)
def test_the_identification_outlives_bad_bags_and_sends_of_no_bag_but_the_loggers_own(
    probe: Probe, start: Callable[..., Started], tmp_path: Path
) -> None:
    """Nothing is found where nothing was planted: the twin of test_loop.py.

    The logger repeats its last bags to whoever comes late, and anybody can speak for it.
    """
    axis, nothing, out = Axis(), tmp_path / 'nothing', tmp_path / 'report'
    flown = write_bag(fly(axis, 1, SHORT), tmp_path / 'flight')
    nothing.mkdir()
    out.mkdir()
    told, name = probe.listen('/diagnostics'), 'identification: identification'

    def until(level: int, words: str) -> dict[str, str]:
        """Wait for a diagnostic of this level with these words; its values."""

        def said() -> bool:
            found = entries(told).get(name)
            return found is not None and found.level == level and words in found.message

        probe.until(said, words)
        return entries(told)[name].values

    def say_bag(path: Path, state: str = 'complete') -> None:
        """In the logger's name, which anybody can do."""
        said = {**event({'path': str(path), 'state': state}), 'node': '/bag_logger'}
        probe.publish('/logger/bag', said)

    say_bag(tmp_path / 'older')
    say_bag(flown)
    node = start('identification', axes='[roll]', out=out, folder=tmp_path, auto_update='true',
                 broken=EACH_ONCE)
    values = until(OK, 'complete before this node began')
    assert values['bag'] == str(flown)
    assert values['report'] == str(tmp_path / 'report.1' / 'report.json')
    report = Path(values['report'])
    assert report.with_name('report.html').exists()
    assert [*report.parent.glob('pictures/roll_*.png')]
    roll = json.loads(report.read_text())['axes']['roll']
    assert (roll['verdict'], roll['effects']) == ('no_missing_effect', [])
    assert roll['error']['after'] == pytest.approx(roll['error']['before'], rel=1e-12)
    found = {p['name']: p['value'] for p in roll['base']['parameters']}
    assert found['gain'] == pytest.approx(axis.gain, rel=0.03)
    late_s = axis.lag_s + 1e-3 * axis.delay_ms
    assert found['lag'] + found['delay'] == pytest.approx(late_s, rel=0.06)

    say_bag(tmp_path / 'no_such_bag')
    until(ERROR, 'no_such_bag: no such bag')
    say_bag(tmp_path / '..' / 'elsewhere')
    until(WARN, 'not read: it does not lie below')
    (tmp_path / 'forged').symlink_to(flown)
    say_bag(nothing)  # the next one waits for it
    for state in ('recording', 'complete'):
        say_bag(tmp_path / 'forged', state)
    until(OK, 'not sent: /bag_logger is not the only publisher of /logger/bag: /probe')
    assert probe.call('/identification/identify').success
    values = until(OK, 'not sent: it was asked for by ~/identify')
    assert f'quad-tune send {values["report"]} sends them: roll.' in node.said
    assert node.end() == 0


def test_what_is_asked_for_comes_first_and_a_name_that_cannot_be_ends_nothing() -> None:
    queue = deque(['waits'])
    node = MagicMock(_worker=None, _queue=queue, _folder=Path('/bags'), _out='')
    node.get_parameter.return_value.value = 'asked'
    assert IdentificationNode._on_identify(node, None, Trigger.Response()).success
    assert [*queue] == ['/bags/asked', 'waits']
    IdentificationNode._work(node, f'/{250 * "x"}')  # whose report has too long a name
    assert 'File name too long' in node._outcome
