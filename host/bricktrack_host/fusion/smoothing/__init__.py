"""The error-state filter and smoother: states, transitions, observations, covariances."""
