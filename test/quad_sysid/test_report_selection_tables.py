"""Approaches, Table 2, one model for roll and pitch and residual tests stand in the page."""

from quad_sysid.report import selection_tables

TREE = {
    'approaches': [
        {'name': 'direct', 'possible': True, 'because': 'command and rate are recorded'},
        {'name': 'indirect', 'possible': False, 'because': 'gains < unknown'},
    ],
    'feedback': True,
    'table2': [
        {'name': 'ARX 10 10 5', 'paper': {'prbs': 73.84, 'square': 80.15, 'train': 98.3,
                                          'kept': True},
         'fit_train_pct': 99.02, 'fit_validation_pct': {'prbs': 95.41, 'square': None},
         'passed_first_step': True, 'because': ''},
    ],
    'roll_and_pitch': {'agree': True, 'because': 'bands overlap', 'model': None,
                       'fit_validation_pct': {'roll': 91.26, 'pitch': None}},
    'residual': {
        'before': {'rms': 0.0092, 'white': False, 'p_white': 1e-9, 'p_input': 0.055,
                   'uncorrelated_with_input': True, 'peaks': [{'frequency_hz': 12.34}],
                   'missing_torque': {'rms': 0.09, 'expected_rms_where_white': 0.083}},
        'after': None, 'blackbox': None,
    },
}


def test_all_four_are_told():
    assert 'gains &lt; unknown' in selection_tables.approaches(TREE)
    assert 'show feedback' in selection_tables.approaches(TREE)
    row = selection_tables.table2(TREE)
    assert 'ARX 10 10 5 *' in row
    assert [part in row for part in ('99.0', '98.3', '95.4', '73.8', '80.2')] == [True] * 5
    assert 'passed the first step' in row
    told = selection_tables.shared(TREE)
    assert 'One model serves roll and pitch: bands overlap.' in told
    assert 'roll 91.3 %' in told
    assert 'pitch –' not in told
    left = selection_tables.residuals(TREE)
    assert 'no (p &lt; 0.0001)' in left
    assert '12.3 Hz' in left


def test_what_is_not_there_is_not_told():
    for part in ('approaches', 'table2', 'shared', 'residuals'):
        assert getattr(selection_tables, part)({}) == ''
