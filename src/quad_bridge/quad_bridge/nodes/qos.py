"""Quality of service of the contract's topics: one table for bridge, logger and their peers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from quad_bridge.topics import LATCHED


def _profile(depth: int, *, latched: bool = False, reliable: bool = True) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


STREAM = _profile(1000)
"""Streams of up to 250 Hz: reliable, also for best-effort subscribers; 4 s deep, so that a logger
without CPU time for a while misses nothing."""
STATE = _profile(1, latched=True)
"""States: segment, active gains, bag. The last one is there for whoever comes late."""
HEARD = _profile(10, latched=True)
"""Reliable reception of states: two that follow at once are both kept."""
EVENT = _profile(10)
"""Messages that only present subscribers need: wanted gains, diagnostics."""


def adapted(topic: str, publishers: Sequence[Any]) -> QoSProfile:
    """QoS for a subscription that matches every publisher of the topic.

    `publishers` are rclpy's TopicEndpointInfo; without any the contract's own QoS is used.
    """
    reliable, latched = True, topic in LATCHED
    for publisher in publishers:
        offer = publisher.qos_profile
        reliable &= offer.reliability == ReliabilityPolicy.RELIABLE
        latched &= offer.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return _profile(1000, latched=latched, reliable=reliable)


def offered(publishers: Sequence[Any]) -> tuple[Qos, ...]:
    """The publishers' QoS in rosbags' terms, to be recorded so that a replay keeps it."""
    profiles = (publisher.qos_profile for publisher in publishers)
    return tuple(
        Qos(
            history=QosHistory.KEEP_LAST,
            depth=max(int(profile.depth), 1),
            reliability=QosReliability(int(profile.reliability)),
            durability=QosDurability(int(profile.durability)),
            deadline=_time(profile.deadline),
            lifespan=_time(profile.lifespan),
            liveliness=QosLiveliness(int(profile.liveliness)),
            liveliness_lease_duration=_time(profile.liveliness_lease_duration),
            avoid_ros_namespace_conventions=bool(profile.avoid_ros_namespace_conventions),
        )
        for profile in profiles
    )


def _time(duration: Any) -> QosTime:
    return QosTime(*divmod(int(duration.nanoseconds), 1_000_000_000))
