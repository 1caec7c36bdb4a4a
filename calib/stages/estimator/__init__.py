"""The fused estimator: from marker pixels and IMU samples to lengths and angle with their covariance."""
