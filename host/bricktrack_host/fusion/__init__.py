"""Camera and IMU together: one time base, one smooth motion."""
