"""Where the smoother's problem is linearised."""

from dataclasses import dataclass

from bricktrack_common.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Where nodes are placed and increments taken."""

    tau_s: float
    skew: float
    lag_s: float
    loss_s2: float
    bg_radps: FloatArray
    ba_mps2: FloatArray
    R_first: FloatArray
    v_first_mps: FloatArray
    p_first_m: FloatArray
    gravity_mps2: FloatArray
