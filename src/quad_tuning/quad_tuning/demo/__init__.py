"""The demo: the loop closed once on a virtual quadrotor, as processes that talk over topics.

Orchestration only: no maths of identification or design stands here.
"""
