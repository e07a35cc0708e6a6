import json
from pathlib import Path

import pytest

from bricktrack_common.errors import StorageError
from bricktrack_device.inertial.imu_calibration import load_calibration, save_calibration

CHIP = "0a" * 16
FIRST, SECOND = bytes(range(22)), bytes(range(22, 44))


def test_a_calibration_comes_back_for_its_chip_and_mode_only(tmp_path: Path) -> None:
    path = save_calibration(tmp_path / "calibration", CHIP, "ndof", FIRST, calib_stat=0xFF)
    save_calibration(tmp_path / "calibration", CHIP, "imuplus", SECOND, calib_stat=0x3C)
    folder = path.parent
    assert path.name == f"{CHIP}.json" and sorted(p.name for p in folder.iterdir()) == [path.name]
    assert load_calibration(folder, CHIP, "ndof") == FIRST
    assert load_calibration(folder, CHIP, "imuplus") == SECOND
    assert load_calibration(folder, "0b" * 16, "ndof") is None
    assert load_calibration(folder, CHIP, "amg") is None


def test_a_newer_calibration_replaces_the_older_of_its_mode(tmp_path: Path) -> None:
    for registers in (FIRST, SECOND):
        save_calibration(tmp_path, CHIP, "ndof", registers, calib_stat=0xFF)
    assert load_calibration(tmp_path, CHIP, "ndof") == SECOND


@pytest.mark.parametrize("damage", ["not json", '{"schema": "other"}', ""])
def test_a_damaged_file_starts_the_sensor_uncalibrated_with_a_warning(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = save_calibration(tmp_path, CHIP, "ndof", FIRST, calib_stat=0xFF)
    path.write_text(damage)
    assert load_calibration(tmp_path, CHIP, "ndof") is None
    assert str(path) in caplog.text and "starts uncalibrated" in caplog.text


def test_another_chips_or_a_newer_file_is_not_believed(tmp_path: Path) -> None:
    path = save_calibration(tmp_path, CHIP, "ndof", FIRST, calib_stat=0xFF)
    (tmp_path / f"{'0b' * 16}.json").write_bytes(path.read_bytes())
    assert load_calibration(tmp_path, "0b" * 16, "ndof") is None
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 2}))
    assert load_calibration(tmp_path, CHIP, "ndof") is None


@pytest.mark.parametrize("chip_id", ["", "../../etc/passwd", "0A" * 16, "0a" * 15])
def test_a_chip_without_a_proper_id_has_no_file(tmp_path: Path, chip_id: str) -> None:
    assert load_calibration(tmp_path, chip_id, "ndof") is None
    with pytest.raises(StorageError, match="could not be read"):
        save_calibration(tmp_path, chip_id, "ndof", FIRST, calib_stat=0xFF)
