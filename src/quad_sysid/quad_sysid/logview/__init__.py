"""What any log shows without a model: traces, step response, spectra, loop, motors, tracking."""
