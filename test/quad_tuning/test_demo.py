"""The demo's parts: processes are watched and all stopped, figures are told.

The observer is flown by test/integration.
"""

from __future__ import annotations

import math
import os
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from probe import PATIENCE_S

pytest.importorskip('ament_index_python', reason='the demo runs in a ROS 2 workspace')

from quad_sysid.loop.figures import SquareFigures, square_figures, square_wave
from quad_sysid.record import Record, Segment
from quad_tuning.demo import processes
from quad_tuning.demo.main import fresh_folder
from quad_tuning.demo.processes import (
    PORT_BASE,
    PORT_GAIN,
    Crew,
    StageFailedError,
    executable,
    own_domain,
)
from quad_tuning.demo.summary import (
    FlightSummary,
    Outcome,
    lines,
    square_of,
)

DT = 0.004
SLEEP = 'import time; time.sleep(600)'


# ---- processes


def python(source: str) -> list[str]:
    return [sys.executable, '-c', source]


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_leaving_stops_all_and_one_that_ignores_sigint_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, 'STOP_PATIENCE_S', 0.3)
    grandchild = tmp_path / 'grandchild'
    source = (
        'import os, signal, subprocess, sys\n'
        'signal.signal(signal.SIGINT, signal.SIG_IGN)\n'
        f'p = subprocess.Popen([sys.executable, "-c", {SLEEP!r}])\n'
        f'open("{grandchild}.new", "w").write(str(p.pid))\n'
        f'os.rename("{grandchild}.new", "{grandchild}")\n{SLEEP}'
    )
    with Crew(tmp_path, 1) as crew:
        crew.start('talker', python(SLEEP))
        crew.start('stubborn', python(source))
        wait_for(grandchild.exists)
        crew.check('now')
    assert crew.children['talker'].process.returncode is not None
    assert (tmp_path / 'logs/talker.log').exists()
    assert crew.children['stubborn'].process.returncode == -9
    status = Path(f'/proc/{grandchild.read_text()}/stat')

    def ended() -> bool:
        try:
            return status.read_text().rpartition(')')[2].split()[0] == 'Z'
        except OSError:  # nobody of that number is left
            return True

    wait_for(ended)


def test_a_death_is_told_with_its_last_words(tmp_path: Path) -> None:
    """One that may end may end but not fail."""
    with Crew(tmp_path, 1) as crew:
        crew.start('done', python(''), may_end=True).process.wait()
        crew.check('fly')
        crew.start('failed', python('raise SystemExit(3)'), may_end=True).process.wait()
        with pytest.raises(StageFailedError, match='failed ended with status 3'):
            crew.check('fly')
    with Crew(tmp_path, 1) as crew:
        crew.start('bridge', python('import sys; sys.exit("no such port")')).process.wait()
        with pytest.raises(StageFailedError, match=r'connect: bridge ended with status 1: no su'):
            crew.check('connect')
    with pytest.raises(StageFailedError, match='no_such_package is not in this workspace'):
        executable('no_such_package', 'x')


def test_two_runs_never_share_a_domain(tmp_path: Path) -> None:
    """Nor one that somebody uses; children get it and the whole environment."""
    environment = Crew(tmp_path, 77).environment()
    assert (environment['ROS_DOMAIN_ID'], environment['PATH']) == ('77', os.environ['PATH'])
    with own_domain() as one, own_domain() as two, own_domain() as three:
        assert len({one, two, three}) == 3
    for offset in (0, 10):
        with own_domain() as free:
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as user:
            user.bind(('', PORT_BASE + PORT_GAIN * free + offset))
            with own_domain() as other:
                assert other != free


# ---- what is kept, compared and told


def test_an_earlier_result_is_kept_aside_never_overwritten(tmp_path: Path) -> None:
    out = tmp_path / 'demo_out'
    assert fresh_folder(out) is None
    assert fresh_folder(out) is None, 'an empty folder is used as it is'
    for number_ in (1, 2):
        (out / 'mark').write_text(str(number_))
        assert fresh_folder(out) == tmp_path / f'demo_out.{number_}'
    assert [(tmp_path / f'demo_out.{k}/mark').read_text() for k in (1, 2)] == ['1', '2']
    assert list(out.iterdir()) == []
    (tmp_path / 'file').write_text('mine')
    with pytest.raises(FileExistsError):
        fresh_folder(tmp_path / 'file')
    assert (tmp_path / 'file').read_text() == 'mine'


def test_the_square_wave_is_cut_out_of_the_right_segment_and_axis() -> None:
    """Pitch follows a square of 0.2 rad by a first-order lag of 0.1 s, from 3 s."""
    reference = np.concatenate([np.full(round(3.0 / DT), 5.0), square_wave(0.2, 1.5, 3, DT)])
    angle, zeros = np.zeros_like(reference), np.zeros((len(reference), 3))
    for k in range(round(3.0 / DT), len(reference)):
        angle[k] = angle[k - 1] + (reference[k - 1] - angle[k - 1]) * DT / 0.1
    flown = Record(
        'flight', DT, zeros, np.zeros((len(reference), 4)), angles=np.outer(angle, [0, 1, 0]),
        attitude_setpoint=np.outer(reference, [0, 1, 0]),
        segments=(Segment('validation', 'square', 'pitch', 'attitude', 3.0, len(angle) * DT),),
    )
    figures = square_figures(*square_of(flown, 'pitch'), DT)
    assert figures.rise_time_s == pytest.approx(0.1 * math.log(9), abs=2 * DT)
    assert figures.overshoot_pct < 0.1
    assert figures.step_rad == pytest.approx(0.4, rel=0.01)
    with pytest.raises(StageFailedError, match='flight holds no square wave on roll'):
        square_of(flown, 'roll')


REPORT = {
    'verdict': 'effects_added',
    'effects': [{
        'name': 'coulomb_friction', 'probability': 0.93,
        'parameters': [{'name': 'torque', 'value': 0.4876, 'std': 0.0123, 'unit': 'rad/s²'}],
    }],
    'error': {'metric': 'rms of the rate', 'unit': 'rad/s', 'before': 0.2, 'after': 0.05},
}


def test_every_figure_stands_in_the_summary_which_fits_a_terminal() -> None:
    def flown(seconds: float, angle_kp: float, *square: float) -> FlightSummary:
        gains = {'roll.angle.kp': angle_kp, 'roll.rate.kp': 0.0745, 'roll.rate.d_filter_hz': 30.0}
        rise_time_s, overshoot_pct, rms_deg = square
        return FlightSummary(seconds, gains, SquareFigures(
            rise_time_s, overshoot_pct, 1.0, 0.0, rms_error_rad=math.radians(rms_deg), edges=4,
            step_rad=0.4,
        ))

    told = lines(Outcome(
        axis='roll', first=flown(66.2, 3.0, 0.512, 23.4, 4.56),
        second=flown(25.0, 4.25, 0.311, 8.1, 3.33), report=REPORT,
        unseen={'before': 0.3, 'after': 0.06}, acknowledged_after_s=0.42,
        folder=Path('demo_out'), files=[('the report', Path('demo_out/report.html'))],
        seconds=180.0,
    ))
    for said in (
        'effects_added', 'coulomb_friction (probability 0.93)', 'torque 0.4876 rad/s²',
        '0.2000 before, 0.0500 after (0.25)', '0.3000 before, 0.0600 after (0.20)', 'report.html',
        'in force 0.4 s after sending', '23.4       8.1\n',
    ):
        assert said in '\n'.join(told)
    table = {line.split()[-4]: line.split()[-3:] for line in told if 'roll.' in line}
    assert table == {
        'roll.angle.kp': ['3', '4.25', '1/s'], 'roll.rate.kp': ['0.0745', '0.0745', 's/rad']
    }
    assert max(map(len, told)) <= 80
    assert 16 <= len(told) <= 30
