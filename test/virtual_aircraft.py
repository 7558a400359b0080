"""The virtual STM32 in memory, as tests fly it: behind a UART of bytes, or without any noise.

The firmware's two lines are bytes: `receive` and `cycle` are the bridge's. Device time is that of
the control cycles, which begin at exactly k cycles.
"""

from __future__ import annotations

from dataclasses import replace

from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import Aircraft, boot
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Receiver, channels_at
from quad_bridge.wire.signing import Signing

_INDEX = {name: index for index, name in enumerate(WIRE_NAMES)}


class Endpoint:
    """A flown aircraft behind a UART."""

    def __init__(
        self, aircraft: Aircraft, script: Receiver, signing: Signing | None = None
    ) -> None:
        self.aircraft, self.script = aircraft, script
        self.firmware = aircraft.firmware
        if signing is not None:
            self.firmware.boot(boot(aircraft.profile).frame(), signing.key, signing.stamp())

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
        """The active value of a parameter by the contract's name."""
        return float(self.firmware.gains()[_INDEX[name]])


def without_noise(profile: Profile) -> Profile:
    """The profile with perfect sensors (filter kept) and no torque noise, for comparisons."""
    quiet = (0.0, 0.0, 0.0)
    mounts = profile.airframe.mounts
    mounts = replace(
        mounts,
        rig=replace(mounts.rig, torque_noise_nm_rthz=quiet),
        hover=replace(mounts.hover, torque_noise_nm_rthz=quiet),
    )
    sensors = replace(
        profile.sensors,
        gyro_noise_rad_s_rthz=0.0,
        gyro_calibration_error_rad_s=0.0,
        gyro_drift_rad_s_rts=0.0,
        accel_noise_m_s2_rthz=0.0,
        accel_bias_m_s2=quiet,
        mag_noise_t=0.0,
        pressure_noise_pa=0.0,
        quantisation=False,
    )
    return replace(profile, airframe=replace(profile.airframe, mounts=mounts), sensors=sensors)
