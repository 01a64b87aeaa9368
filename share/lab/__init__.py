"""The laboratory: emulator, calibration, evaluation, training, studies. The product never imports it."""
