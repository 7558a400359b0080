"""Gains from identified models: PID and LQR design, history, exports, the demo."""
