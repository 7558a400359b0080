"""The remaining time: from counts and stages, on a clock of our own, and only on a terminal."""

import io

import pytest

from quad_sysid.progress import Progress, duration, progress


def shown(lines: list[tuple[float, str]], axes: tuple[str, ...] = ()) -> list[str]:
    stream, times = io.StringIO(), iter([time for time, _ in lines])
    report = Progress(stream, axes, lambda: next(times))
    for _, line in lines:
        report(line)
    return [text.removeprefix('\x1b[2K') for text in stream.getvalue().split('\r')[1:]]


def test_counted_work_tells_what_is_left():
    out = shown([(0.0, 'flight 1 of 5'), (10.0, 'flight 2 of 5'), (20.0, '')])
    assert out == ['flight 1 of 5', 'flight 2 of 5  (10 s so far, about 40 s left)', '']


def test_short_work_tells_no_time():
    assert shown([(0.0, 'a 1 of 2'), (0.9, 'a 2 of 2')])[-1] == 'a 2 of 2'


def test_stages_of_two_axes_never_go_back():
    report = Progress(io.StringIO(), ('roll', 'pitch'))
    shares = [report.share(line) for line in (
        'reading bag', 'roll: what is missing', 'roll: held-out segments',
        'roll: black-box models', 'roll: gains', 'pitch: what is missing',
        'pitch: black-box models', 'writing out',
    )]
    assert shares == sorted(shares)
    assert shares[5] == pytest.approx(0.4 + 0.4 * 0.05)


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [(0.2, '1 s'), (59.4, '59 s'), (200.0, '3 min 20 s'), (7500.0, '2 h 5 min')],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_nothing_is_shown_where_stderr_is_no_terminal(capsys):
    progress()('reading')
    assert capsys.readouterr().err == ''
