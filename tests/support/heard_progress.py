"""A listener to the progress of a run's processing."""


class Heard:
    """Keeps what it was told."""

    def __init__(self):
        self.stages = []
        self.done = []

    def stage(self, name, total):
        self.stages.append((name, total))

    def advance_to(self, done):
        self.done.append(done)
