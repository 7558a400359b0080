"""Quality of service of the contract's topics: one table for bridge, logger and their peers."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""Streams of up to 250 Hz: reliable, 0.4 s deep, readable by best-effort subscribers too."""

STATE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""States that a late subscriber must see: segment, active gains, bag."""

EVENT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""Requests that count when they happen and not later: wanted gains, diagnostics."""

LATCHED_TOPICS = frozenset({'/excitation/segment', '/gains/active', '/logger/bag'})
