"""Simulated hardware: one seeded world that the camera, the IMU and the trigger all ask."""
