"""What the fusion believes of sensors and clocks before the data speak."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """What is believed of sensors and clocks before the data speak; SI units.

    Attributes
    ----------
    gyro_noise_radps, acc_noise_mps2 : float
        White noise of one sample: BNO055 data sheet densities over its default bandwidths (0.1 deg/s and
        0.012 m/s^2), and the rounding to 1/16 deg/s and 0.01 m/s^2.
    gyro_scale_sd, acc_scale_sd : float
        Scale and cross-axis errors left after calibration, which change with the motion.
    sensor_gain_sd : float
        Scale and cross-axis errors that stand still, and are estimated with the run (data sheet: 1 %; zero:
        none).
    lever_arm_sd_mm : float
        How well the IMU's place in the brick is known: to a millimetre as it is glued in, and to another
        within its case. It is estimated with the run.
    camera_delay_sd_ns, camera_delay_rate_sd : float, ns and 1
        How well the delay of a moving camera's sensor against the brick's is known, and its rate: sensors
        sample by oscillators of their own. Both are estimated with the run.
    systematic_time_s : float
        How long errors by scale and lever arm keep their sign: about a tenth of a second at 2-10 Hz.
    roughness_share : float
        Error of a sample, as white noise, over the steady roughness of the samples: 1 for noise. A vibration
        at one pitch integrates to far less: see `adapt_noise`.
    gyro_impact_share, acc_impact_share : float
        Error of the three samples about a pulse over its height. A pulse of a few ms seen at 100 Hz may be
        hit at its peak or at its foot, so the velocity change is unsure by more than height times 10 ms. The
        angular rate only steps at an impact.
    impact_arm_mm : float
        What turns the brick also shoves it, were it missed by the accelerometer: change of velocity over
        change of angular rate.
    adapt_noise : bool
        Whether each run chooses its shares of roughness and its multiples of the systematic errors by the
        likelihood of its frames.
    vibration_beside_camera : bool
        Whether the slow accelerations that a vibration leaves in the samples are sought beside the camera's.
    gyro_bias_walk_radps, acc_bias_walk_mps2 : float
        Wander of the biases in one second.
    gyro_bias_sd_radps, acc_bias_sd_mps2 : float
        Of the biases at the start (data sheet: 1-3 deg/s, 80 mg).
    gravity_mps2, gravity_sd_mps2 : float
        Its size; the default covers the whole Earth.
    offset_prior_sd_ns : float, ns
        A measured alignment enters no tighter than this, nor than its own sd.
    acc_lag_ns, acc_lag_sd_ns : float, ns
        Accelerometer minus gyro low-pass lag, and how well it is known; BNO055 default bandwidths: -3.4 ms.
    acc_loss_sd_s2 : float, s^2
        Of what the accelerometer's low-pass takes from its second derivative: for a critically damped one of
        second order half the delay squared, 3e-6 at the BNO055's 62.5 Hz. None is expected.
    optical_common_share : float
        Part of the optical sd that neighbouring frames have in common (LED profile, calibration, pixel grid)
        and that no averaging over frames takes away, where poses do not say it themselves. It is added to the
        covariance that is given out.
    gate_chi2 : float
        A frame whose residual to all the others, squared over its covariance, exceeds this is left out
        (6 degrees of freedom; 33 is passed by all but one in 100 000).
    contest_chi2 : float
        A frame that is left out counts for nothing beyond this, and below it for as much as the samples that
        contradict it, see `contested_frames`: some 24 sd, past what lights and lenses do to a pose.
    impact_mps2 : float
        Height above which a pulse is flagged as an impact.
    max_position_sd_mm, max_rotation_sd_rad : float
        A pose less sure than this is given as NaN.
    """

    gyro_noise_radps: float = 2e-3
    acc_noise_mps2: float = 0.015
    gyro_scale_sd: float = 0.004
    acc_scale_sd: float = 0.004
    sensor_gain_sd: float = 0.01
    lever_arm_sd_mm: float = 2.0
    camera_delay_sd_ns: float = 0.3e6
    camera_delay_rate_sd: float = 5e-4
    systematic_time_s: float = 0.1
    roughness_share: float = 1.0
    gyro_impact_share: float = 0.3
    acc_impact_share: float = 1.0
    impact_arm_mm: float = 100.0
    adapt_noise: bool = True
    vibration_beside_camera: bool = True
    gyro_bias_walk_radps: float = 3e-4
    acc_bias_walk_mps2: float = 0.01
    gyro_bias_sd_radps: float = 0.02
    acc_bias_sd_mps2: float = 0.5
    gravity_mps2: float = 9.80665
    gravity_sd_mps2: float = 0.03
    offset_prior_sd_ns: float = 0.15e6
    acc_lag_ns: float = 0.0
    acc_lag_sd_ns: float = 4e6
    acc_loss_sd_s2: float = 4e-6
    optical_common_share: float = 0.3
    gate_chi2: float = 33.0
    contest_chi2: float = 600.0
    impact_mps2: float = 3.0
    max_position_sd_mm: float = 50.0
    max_rotation_sd_rad: float = 0.3
