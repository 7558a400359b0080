"""A fit handed on as a model: its parameters as a report reads them, and the same run again."""

import pytest

from quad_sysid.report import document, words

# up to where a model is worth something


def test_the_error_over_the_horizon_grows_from_the_noise_and_is_told(rubbed_answer):
    tree = document.document({'roll': rubbed_answer}, ['bag'])['axes']['roll']
    listed = tree['error']['horizons']
    assert [h['horizon_s'] for h in listed] == [0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    for h in listed[1:]:
        assert h['after'] < h['before'] < h['hold'], h
        assert h['blackbox'] is not None
    assert listed[0]['after'] < 2.0 * tree['error']['noise_floor']
    assert listed[-1]['before'] > 2.0 * listed[1]['before']
    noise = {p['name']: p['value'] for p in tree['base']['noise']}
    assert set(noise) >= {'disturbance_rms', 'disturbance_correlation', 'measurement_rms'}


@pytest.mark.parametrize(
    ('after', 'far'), [((0.1, 0.1, 0.1), 1.0), ((0.1, 0.2, 0.9), 0.1), ((0.4, 0.8, 0.9), None)]
)
def test_worth_ends_where_holding_is_no_longer_twice_as_wrong(after, far):
    error = {'unit': 'rad/s', 'horizons': [
        {'horizon_s': s, 'hold': hold, 'before': 1.0, 'after': one, 'blackbox': None}
        for s, hold, one in zip((0.05, 0.1, 1.0), (0.5, 1.0, 1.2), after, strict=True)
    ]}
    assert words.reach(error) == far
