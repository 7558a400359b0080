"""An earlier result is kept aside, never overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest

from quad_tuning.demo.folders import fresh_folder


def test_earlier_runs_are_numbered(tmp_path: Path) -> None:
    out = tmp_path / 'demo_out'
    assert fresh_folder(out) is None
    assert fresh_folder(out) is None, 'an empty folder is used as it is'
    for number in (1, 2):
        (out / 'mark').write_text(str(number))
        assert fresh_folder(out) == tmp_path / f'demo_out.{number}'
    assert (tmp_path / 'demo_out.1/mark').read_text() == '1'
    assert (tmp_path / 'demo_out.2/mark').read_text() == '2'
    assert list(out.iterdir()) == []


def test_a_file_in_the_way_is_an_error(tmp_path: Path) -> None:
    (tmp_path / 'demo_out').write_text('mine')
    with pytest.raises(FileExistsError):
        fresh_folder(tmp_path / 'demo_out')
    assert (tmp_path / 'demo_out').read_text() == 'mine'
