"""The laboratory: emulator, calibration, evaluation, training. The product never imports it."""
