"""Controllers of the two-bellows actuator: from errors and set-points to PWM values."""
