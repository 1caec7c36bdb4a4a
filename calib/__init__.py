"""Calibrate a cheap camera and an IMU on a machine, down to the constants in its firmware."""

__version__ = "0.1.0"
