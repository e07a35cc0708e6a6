"""What a process of its own sees of a simulated world: here, where such a process can import it."""

from multiprocessing.connection import Connection

import numpy as np

from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import Epoch, SimWorld


def tell_first_edge_and_place(settings: SimSettings, epoch: Epoch, t_ns: int, answer: Connection) -> None:
    """Send the first edge's stamp, and where the brick is at an instant, mm."""
    world = SimWorld(settings, epoch)
    answer.send((world.first_edge_ns, world.pose(np.array([t_ns]))[1].tolist()))
