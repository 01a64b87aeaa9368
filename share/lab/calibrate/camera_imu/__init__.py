"""Calibration of camera-IMU extrinsics and time offset: a B-spline of the motion, fitted to both."""
