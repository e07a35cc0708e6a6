"""The dot target: its code tells every place of it, and its file comes back as it was."""

import numpy as np
import pytest

from bricktrack_common.errors import CalibrationError, ConfigError
from bricktrack_host.calibration.target.printed_target import (
    DotTarget,
    check_target,
    load_target,
    target_toml,
)

SAMPLE = DotTarget(columns=54, rows=32, pitch_mm=4.0, diameter_mm=2.0)


def test_every_window_of_eight_by_eight_dots_is_told_from_every_other_in_any_quarter_turn():
    large = SAMPLE.large_dots()
    windows = np.lib.stride_tricks.sliding_window_view(large, (8, 8)).reshape(-1, 8, 8)
    here = windows.reshape(-1, 64).astype(np.float32)
    for quarter in range(4):
        there = np.rot90(windows, quarter, axes=(1, 2)).reshape(-1, 64).astype(np.float32)
        differing = here @ (1 - there).T + (1 - here) @ there.T
        if quarter == 0:
            np.testing.assert_array_equal(np.diag(differing), 0)
            np.fill_diagonal(differing, 64)
        # Two misread dots on either side can never make one place look like another.
        assert differing.min() >= 5


def test_a_quarter_of_the_dots_is_large():
    # 1728 dots: the share's own scatter is 1 %.
    assert abs(SAMPLE.large_dots().mean() - 0.25) < 0.03
    assert not DotTarget(columns=9, rows=9, pitch_mm=4.0, diameter_mm=2.0, coded=False).large_dots().any()


def test_a_larger_target_continues_a_smaller_one():
    small = DotTarget(columns=32, rows=18, pitch_mm=4.0, diameter_mm=2.0)
    np.testing.assert_array_equal(SAMPLE.large_dots()[7:25, 11:43], small.large_dots())
    np.testing.assert_array_equal(SAMPLE.centres_mm()[7:25, 11:43], small.centres_mm())


def test_the_file_comes_back_as_it_was(tmp_path):
    for target in (
        SAMPLE,
        DotTarget(columns=7, rows=5, pitch_mm=1 / 3, diameter_mm=0.1, polarity="black-on-white", coded=False),
    ):
        (tmp_path / "t.toml").write_text(target_toml(target))
        assert load_target(tmp_path / "t.toml") == target


def test_wrong_targets_are_named(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text(target_toml(SAMPLE).replace("= 54", "= 1"))
    with pytest.raises(ConfigError, match=r"t\.toml: target\.columns"):
        load_target(path)
    with pytest.raises(CalibrationError, match=r"diameter of at most 2\.28571 mm \(large dots"):
        check_target(DotTarget(columns=9, rows=9, pitch_mm=4.0, diameter_mm=2.5))
