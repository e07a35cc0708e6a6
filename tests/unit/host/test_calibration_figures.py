import numpy as np
from lens_boards import brown, two_planes
from matplotlib.quiver import Quiver

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_host.calibration.calibration_comparison import CalibrationComparison
from bricktrack_host.reporting.calibration_figures import comparison_figure, residual_arrow_figure


def tips(quiver):
    """Where the arrows end, in the axes' units; lengths are ``angles="xy", scale_units="xy"``."""
    return np.column_stack([quiver.X + quiver.U / quiver.scale, quiver.Y + quiver.V / quiver.scale])


def assert_arrows_lie_within(fig):
    fig.draw_without_rendering()
    panels = [ax for ax in fig.axes if any(isinstance(c, Quiver) for c in ax.collections)]
    assert len(panels) == 2
    for ax in panels:
        (quiver,) = (c for c in ax.collections if isinstance(c, Quiver))
        for values, limits in zip(tips(quiver).T, (ax.get_xlim(), ax.get_ylim()), strict=True):
            assert min(limits) <= values.min() and values.max() <= max(limits)


def test_arrows_of_residuals_end_within_the_axes_however_long_some_are():
    planes = two_planes(brown, 3)
    for worst in (1.0, 8.0, 300.0):
        residual_mm = [np.full((len(seen.xy_mm), 2), 5e-4) for _, seen in planes]
        residual_mm[0][-1] *= worst  # at the border, where maps are worst
        assert_arrows_lie_within(residual_arrow_figure(planes, residual_mm))


def test_arrows_of_a_comparison_end_within_the_axes():
    mode = IMX219_1080P
    uv_px = np.array([[0.0, 0.0], [mode.width - 1.0, 0.0], [0.0, mode.height - 1.0]])
    outwards_mm = 1e-3 * np.array([[-1.0, 0.0], [1.0, -0.2], [0.0, 1.0]])
    comparison = CalibrationComparison(
        uv_px, 130.0, outwards_mm, np.zeros(3), np.zeros(3), 0.5 * outwards_mm, 1.0
    )
    assert_arrows_lie_within(comparison_figure(comparison, mode))
