"""The contract's base as a grey box: exact drive, compiled free run, fit, error metric."""
