"""The inertial sensor: its angle filter and its errors."""
