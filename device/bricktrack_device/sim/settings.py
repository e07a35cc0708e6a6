"""The ``[sim]`` table of the configuration: which world the simulated sensors live in."""

from typing import Annotated, Literal

import msgspec

_NotNegative = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=0)]
Interval = tuple[_NotNegative, _Positive]
"""Start after the first edge, and duration, s."""


class HiddenLed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One LED that something stands before for a while; seconds after the first edge."""

    name: str
    start_s: _NotNegative
    duration_s: _Positive


class SimFaults(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[sim.faults]``: what the simulated hardware does wrong, on purpose.

    Attributes
    ----------
    drop_frame_every : int
        Every n-th frame never leaves the camera; 0 for none.
    camera_dies_after_s : float or None
        Frames stop coming so long after the start, as when picamera2's thread dies.
    imu_nack_every, imu_nack_errno : int
        Every n-th transaction fails with this error number.
    imu_reset_s, imu_stuck_s : float or None
        The sensor resets itself silently, or repeats itself for ever, so long after the first edge.
    imu_absent : bool
        Nothing answers on the bus.
    imu_bus_down : list of (start_s, duration_s)
        When every transaction fails with ``imu_nack_errno``, after the first edge.
    imu_bit_flip_every : int
        Every n-th burst arrives with a wrong bit in the first channel's high byte.
    missed_edges : list of int
        Numbers of rising edges that the unit never hears of; 0 is the first.
    late_edges : list of (number, us)
        Rising edges that are stamped so much too late.
    """

    drop_frame_every: _Count = 0
    camera_dies_after_s: _NotNegative | None = None
    imu_nack_every: _Count = 0
    imu_nack_errno: int = 121
    imu_reset_s: _NotNegative | None = None
    imu_stuck_s: _NotNegative | None = None
    imu_absent: bool = False
    imu_bus_down: list[Interval] = []
    imu_bit_flip_every: _Count = 0
    missed_edges: list[_Count] = []
    late_edges: list[tuple[_Count, _NotNegative]] = []


class SimImu(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[sim.imu]``: the simulated BNO055, one on every bus that is opened.

    Attributes
    ----------
    address : int
        Where it answers.
    sample_hz : float
        How often it has a new sample.
    clock_ppm : float or None
        How much too slow its own clock is; by default the seed says, some 2000 ppm either way. Reads beat
        with it: a sample is up to ``1 / sample_hz`` old, and now and then the same one is read twice.
    noise, bias : float
        Times those of the data sheet.
    on_camera : list of str
        Buses whose chip sits on the camera's component, and not on the brick.
    on_camera_mm : (float, float, float), mm
        Where it sits there, seen from the projection centre, camera axes; its axes are the camera's.
    """

    address: Literal[0x28, 0x29] = 0x28
    sample_hz: Annotated[float, msgspec.Meta(ge=10, le=2000)] = 100.0
    clock_ppm: float | None = None
    noise: _NotNegative = 1.0
    bias: _NotNegative = 1.0
    on_camera: list[str] = []
    on_camera_mm: tuple[float, float, float] = (18.0, -25.0, -7.0)


class SimSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[sim]``: one seeded world; the same settings give the same shake.

    Attributes
    ----------
    seed : int
        Of everything random: phases, noise, sensor biases.
    layout : str, path
        Layout file of the brick; ``""``: the kit's own, the paper's seven LEDs.
    motion : "sines", "sweep", "impacts" or "csv"
        Sines of 2 to 20 Hz; a sweep through these; sines with an impact every second or so; or the motion in
        ``motion_csv`` (columns ``t_s, x_mm, y_mm, z_mm`` and, if wanted, ``rx_deg, ry_deg, rz_deg``).
    amplitude_mm, amplitude_deg : float
        Largest displacement and rotation along an axis, roughly.
    camera_acc_g, camera_rocking_deg : float
        How the camera's own component moves while the brick shakes: rms of its acceleration and of its
        rotation, along and about each axis, 3 to 10 Hz. What the camera sees of the brick stays the same.
    impact_mps : float
        Largest change of velocity in an impact, within 1 to 3 ms: 0.1 m/s is 5 to 16 g, more clips at 16 g.
    shake_delay_s : float
        From arming to the first rising edge.
    quiet_s, shake_s : float
        Rest after the first edge, then shake.
    square_wave_hz : float
        By the laboratory's clock, which the unit's differs from by ``clock_ppm``.
    edge_jitter_us : float
        Of the stamps, standard deviation.
    dropouts : list of (start_s, duration_s)
        When an opaque card hides the whole view, after the first edge.
    hidden_leds : list of HiddenLed
    collar_mm : float
        Length of the lit cylinder behind each dome.
    led_level : float
        Brightness of the LEDs in linear light; 1 just fills the sensor, more saturates it.
    clutter : float
        Brightness of the surroundings and of reflections, 0 for a black box.
    noise : float
        Times the ordinary shot and read noise.
    imu : SimImu
    faults : SimFaults
    """

    seed: int = 1
    layout: str = ""
    motion: Literal["sines", "sweep", "impacts", "csv"] = "impacts"
    motion_csv: str = ""
    amplitude_mm: _NotNegative = 3.0
    amplitude_deg: _NotNegative = 2.0
    impact_mps: _NotNegative = 0.1
    camera_acc_g: _NotNegative = 0.0
    camera_rocking_deg: _NotNegative = 0.0
    shake_delay_s: _Positive = 1.0
    quiet_s: _NotNegative = 1.0
    shake_s: _Positive = 12.0
    square_wave_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 200.0
    clock_ppm: float = 20.0
    edge_jitter_us: _NotNegative = 5.0
    dropouts: list[Interval] = []
    hidden_leds: list[HiddenLed] = []
    collar_mm: _NotNegative = 0.7
    led_level: _Positive = 0.9
    clutter: _NotNegative = 1.0
    noise: _NotNegative = 1.0
    imu: SimImu = SimImu()
    faults: SimFaults = SimFaults()
