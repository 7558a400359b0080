"""A virtual STM32 that stands, bridge and logger as processes: calibrated, armed, and in the bag.

What the bridge subtracts is told in the bag; the command `sensors` has the readings back from it.
They fly in lockstep: the second in which the STM32 has to answer is one of simulated time.
"""

import numpy as np
import pytest
import yaml
from node_process import program, recorded
from probe import stamp_ns

from quad_bridge.lockstep import VARIABLE
from quad_bridge.sensors.command import main as sensors
from quad_bridge.sensors.correction import as_sent, from_values

STANDING = """
mount: rig
airframe:
  mounts:
    rig: {damping_per_s: 0.4, bias_torque_nm: 0.0, torque_noise_nm_rthz: 0.0}
sensors: {gyro_calibration_error_rad_s: 0.02}
firmware: {auto_arm: false}
"""


def test_calibrated_at_rest_armed_and_recorded(tmp_path, monkeypatch, run, start, probe, capsys):
    (tmp_path / 'standing.yaml').write_text(STANDING)
    link, line = tmp_path / 'tty', tmp_path / 'line'
    stm32 = run(*program('virtual_stm32'), '--profile', tmp_path / 'standing.yaml',
                '--link', link, '--seed', 5, '--lockstep', line)  # fmt: skip
    stm32.until(link.exists)
    monkeypatch.setenv(VARIABLE, str(line))
    logger = start('bag_logger', folder=tmp_path / 'bags', autostart=True)
    imu = probe.listen('/imu/data')

    def fly(cycles):
        heard = len(imu)
        probe.until(lambda: len(imu) > heard + cycles)

    bridge = start('serial_bridge', port=link, state_folder=tmp_path / 'state')
    written = ('bag_logger: recording', 'messages written')
    probe.until(lambda: int(probe.diagnostics(*written) or 0) > 500, 'messages in the bag')
    fly(1250)  # five seconds at rest in the bag
    calibrate = '/serial_bridge/calibrate_at_rest'
    probe.until(lambda: probe.call(calibrate).success)
    fly(500)
    armed = probe.call('/serial_bridge/arm', 'std_srvs/srv/SetBool', data=True)
    assert armed.success, armed.message
    fly(25)  # its answer may be heard before the first cycle that is armed
    refused = probe.call(calibrate)
    assert (refused.success, 'it is armed' in refused.message) == (False, True), refused.message
    fly(125)
    assert [process.end() for process in (bridge, logger, stm32)] == [0, 0, 0]

    (bag,) = (tmp_path / 'bags').glob('flight_*')
    found = recorded(bag)
    told = [
        from_values({v.key: v.value for v in status.values})
        for array in found['/diagnostics']
        for status in array.status
        if status.name == 'serial_bridge: sensors'
    ]
    # nothing from the first stamp on, an estimate as the recording began, or both; asked; arming
    begins = sorted({one.since_ns for one in told if one.since_ns})
    assert len(begins) in {3, 4}
    asked, armed_ns = begins[-2:]
    stamps = np.array([stamp_ns(m) for m in found['/imu/data']])
    turns = [m.angular_velocity for m in found['/imu/data']]
    rates = np.array([(turn.x, turn.y, turn.z) for turn in turns])
    sent = as_sent(stamps, rates, told)[stamps < asked].mean(axis=0)
    # it moves as soon as it is armed, the bridge's tick comes up to 0.1 s later
    after = rates[(stamps >= asked) & (stamps < armed_ns - 3 * 10**8)]
    assert np.abs(sent).max() > 5e-3
    # six seconds averaged, two compared, noise of 5e-3 rad/s, neighbours related by the filter
    assert np.abs(after.mean(axis=0)).max() < 2e-3
    stood = str(1e-9 * (armed_ns - stamps[0]) - 0.3)
    sensors(['rest', str(bag), '--out', str(tmp_path / 'again.yaml'), '--seconds', stood])
    capsys.readouterr()
    again = yaml.safe_load((tmp_path / 'again.yaml').read_text())['sensors']['rest']
    assert again['gyro_bias'] == pytest.approx(sent, abs=2e-3)
