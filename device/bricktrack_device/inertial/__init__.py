"""The BNO055: its registers, its calibration, its samples every 10 ms."""
