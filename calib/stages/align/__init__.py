"""Camera and IMU together: time offset, mount angle, scales and biases."""
