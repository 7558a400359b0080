"""The first lines of the nodes' processes: see quad_bridge.start. No node itself."""

from __future__ import annotations

from quad_bridge.start import begin


def excitation() -> None:
    """`ros2 run quad_sysid excitation`."""
    begin('quad_sysid.excitation_node')


def identification() -> None:
    """`ros2 run quad_sysid identification`."""
    begin('quad_sysid.identification_node')
