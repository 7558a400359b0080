"""What `import quad_sysid` offers: the names that the field expects, loaded when used."""

import subprocess
import sys

import numpy as np
import pytest

import quad_sysid

NAMES = (
    'read_bag', 'Record', 'IOData', 'arx', 'armax', 'oe', 'bj', 'iv4', 'clriv', 'n4sid', 'greybox',
    'search_arx', 'delay_estimate', 'Model', 'simulate', 'predict', 'fit_percent', 'compare',
    'residual_test', 'frequency_response', 'spa', 'coherence', 'excitation_order',
)


def test_every_promised_name_is_there():
    assert all(callable(getattr(quad_sysid, name)) for name in NAMES)
    assert set(NAMES) <= set(quad_sysid.__all__) <= set(dir(quad_sysid))
    assert all(getattr(quad_sysid, name) is not None for name in quad_sysid.__all__)
    with pytest.raises(AttributeError, match='no attribute'):
        quad_sysid.nothing  # noqa: B018


def printed_by(code: str) -> str:
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_the_import_loads_nothing_heavy_and_the_models_need_neither_ros_nor_matplotlib():
    assert printed_by(
        'import sys, quad_sysid, quad_sysid.cli; '
        'print(sorted({"numba", "scipy", "matplotlib", "rclpy"} & set(sys.modules)))'
    ) == '[]'
    assert printed_by(
        'import sys\n'
        'for name in ("rclpy", "matplotlib", "rosbags"): sys.modules[name] = None\n'
        'import quad_sysid; assert "numpy" not in sys.modules\n'
        'from quad_sysid import IOData, arx, greybox\n'
        'import numpy as np\n'
        'u = np.random.default_rng(0).standard_normal(500)\n'
        'print(arx(IOData(u, np.roll(u, 1), 0.01), 1, 1, 1).name, callable(greybox))'
    ) == 'ARX 1 1 1 True'


def test_the_grey_box_is_a_call_on_the_same_data(plain_flight):
    """The plant of conftest.py: each value within 4 standard errors."""
    z = plain_flight.axis('roll', 'train')
    found = quad_sysid.greybox(z)
    assert found.converged
    truth = {'gain': 450.0, 'lag': 0.042, 'delay': 0.008, 'damping': 0.4, 'bias': 0.2}
    for name, std in zip(found.parameter_names, found.std, strict=True):
        off = abs(found.value(name) - truth[name])
        assert off < 4.0 * std, (name, found.value(name), std)
    assert found.noise.measured_rms == pytest.approx(0.005, rel=0.1)
    with pytest.raises(ValueError, match='gyro_filter_hz'):
        quad_sysid.greybox(z, gyro_filter_hz=1e4)


def test_a_rate_that_does_not_fit_is_told():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(300)
    y = np.roll(u, 1) + 0.1 * rng.standard_normal(300)
    model = quad_sysid.arx(quad_sysid.IOData(u, y, 0.01), 1, 1, 1)
    other = quad_sysid.IOData(u, y, 0.02)
    for call in (quad_sysid.compare, quad_sysid.residual_test,
                 lambda m, z: quad_sysid.predict(m, z, 1)):
        with pytest.raises(ValueError, match='100 Hz: found 50 Hz'):
            call(model, other)
    with pytest.raises(ValueError, match='greybox'):
        quad_sysid.greybox(quad_sysid.IOData(u, y, 0.01))
