"""The virtual STM32 in memory, as tests fly it: behind a UART of bytes, or without any noise.

The firmware's two lines are bytes: `receive` and `cycle` are the bridge's. Device time is that of
the control cycles, which begin at exactly k cycles.
"""

from dataclasses import replace

from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.airframe import Airframe, Mounts, Surroundings
from quad_bridge.virtual.effects import Effects
from quad_bridge.virtual.physics import RATES
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Receiver, channels_at

_INDEX = {name: index for index, name in enumerate(WIRE_NAMES)}


class Endpoint:
    """A flown aircraft behind a UART."""

    def __init__(self, aircraft: Aircraft, script: Receiver) -> None:
        self.aircraft, self.script = aircraft, script
        self.firmware = aircraft.firmware

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Take bytes that arrived at device time `now_ns`; returns the bytes of the answers."""
        return self.firmware.receive(data, now_ns // 1000)

    def cycle(self) -> bytes:
        """Run the next control cycle; returns the bytes that the STM32 sends in it."""
        aircraft = self.aircraft
        channels = channels_at(self.script, aircraft.cycle * aircraft.cycle_s)
        aircraft.move(hil.motors(self.firmware.cycle(aircraft.measure(channels))))
        return self.firmware.send()

    def gain(self, name: str) -> float:
        return float(self.firmware.gains()[_INDEX[name]])


def without_noise(profile: Profile) -> Profile:
    """The profile with perfect sensors (filter kept) and no torque noise, for comparisons."""
    quiet = (0.0, 0.0, 0.0)
    mounts = profile.airframe.mounts
    mounts = replace(
        mounts, rig=replace(mounts.rig, torque_noise_nm_rthz=quiet),
        hover=replace(mounts.hover, torque_noise_nm_rthz=quiet))
    sensors = replace(
        profile.sensors, gyro_noise_rad_s_rthz=0.0, gyro_calibration_error_rad_s=0.0,
        gyro_drift_rad_s_rts=0.0, accel_noise_m_s2_rthz=0.0, accel_bias_m_s2=quiet,
        mag_noise_t=0.0, pressure_noise_pa=0.0, quantisation=False)
    return replace(profile, airframe=replace(profile.airframe, mounts=mounts), sensors=sensors)


def quiet_profile(
    effects: Effects | None = None, damping: float = 0.0, bias: float = 0.0, **changes: object
) -> Profile:
    """No noise, on a rig of this damping (1/s) and this bias torque (N m) about roll."""
    still = Surroundings(
        damping_per_s=(damping,) * 3, bias_torque_nm=(bias, 0.0, 0.0),
        torque_noise_nm_rthz=(0.0,) * 3,
    )  # fmt: skip
    airframe = Airframe(mounts=Mounts(rig=still, hover=still))
    return without_noise(Profile(airframe=airframe, effects=effects or Effects(), **changes))


def coasting(profile: Profile, rates: tuple[float, float, float]) -> Aircraft:
    """Motors stopped, given body rates, rad/s."""
    profile = replace(profile, firmware=replace(profile.firmware, auto_arm=False))
    aircraft = Aircraft(profile, seed=1)
    aircraft.machine.state[RATES : RATES + 3] = rates
    return aircraft


def open_loop(aircraft: Aircraft) -> None:
    aircraft.set_gains(
        {name: 0.0 for name in aircraft.gains if name.endswith(('.kp', '.ki', '.kd'))}
    )
