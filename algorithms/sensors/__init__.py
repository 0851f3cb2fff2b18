"""Calibration of inertial and magnetic sensors."""
