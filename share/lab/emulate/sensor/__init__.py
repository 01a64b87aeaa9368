"""The device: what a camera and an IMU make of a room and a motion."""
