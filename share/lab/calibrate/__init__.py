"""Calibration of cameras and IMU (`share calibrate`)."""
