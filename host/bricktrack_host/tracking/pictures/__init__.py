"""The lights of the LEDs in pictures: windows, bright spots, centroids and their uncertainty."""
