"""The pictures of a report, kept beside the results: the report can be written again without the video."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_host.reporting.page_picture import PagePicture, page_picture
from bricktrack_host.reporting.plots import CalibrationPicture, FrameOverlay

PICTURES_NAME = "pictures.npz"


def save_pictures(path: Path, overlays: Sequence[FrameOverlay], calibration: CalibrationPicture) -> None:
    """Write overlays and the calibration's outline to one file.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    values: dict[str, np.ndarray] = {
        "size_px": np.array([calibration.width_px, calibration.height_px]),
        "n_outlines": np.array(len(calibration.covered_uv_px)),
        "titles": np.array([o.title for o in overlays]),
    }
    for i, outline in enumerate(calibration.covered_uv_px):
        values[f"outline_{i}"] = outline
    for i, o in enumerate(overlays):
        values[f"jpeg_{i}"] = np.frombuffer(o.picture.jpeg, dtype=np.uint8)
        values[f"of_px_{i}"] = np.array([o.picture.width_px, o.picture.height_px])
        values[f"detected_{i}"], values[f"predicted_{i}"] = o.detected_uv_px, o.predicted_uv_px
    try:
        np.savez(path, allow_pickle=False, **values)
    except OSError as e:
        raise StorageError(f"{path}: {e.strerror or e}") from e


def load_pictures(path: Path) -> tuple[list[FrameOverlay], CalibrationPicture | None]:
    """Return what `save_pictures` wrote; nothing where there is no such file.

    Raises
    ------
    RunFormatError
        If the file is damaged.
    """
    if not path.is_file():
        return [], None
    try:
        with np.load(path, allow_pickle=False) as file:
            overlays = []
            for i, title in enumerate(file["titles"].tolist()):
                image = cv2.imdecode(file[f"jpeg_{i}"], cv2.IMREAD_GRAYSCALE)
                if image is None:
                    raise RunFormatError(f"{path}: picture {i} is no JPEG. Process the run again")
                if f"of_px_{i}" in file:
                    picture = PagePicture(file[f"jpeg_{i}"].tobytes(), *file[f"of_px_{i}"].tolist())
                else:  # of before they were shrunk to be kept
                    picture = page_picture(np.asarray(image, dtype=np.uint8))
                overlays.append(FrameOverlay(title, picture, file[f"detected_{i}"], file[f"predicted_{i}"]))
            width, height = file["size_px"].tolist()
            outlines = [file[f"outline_{i}"] for i in range(int(file["n_outlines"]))]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as e:
        if isinstance(e, RunFormatError):
            raise
        raise RunFormatError(f"{path}: damaged: {e}. Process the run again") from e
    return overlays, CalibrationPicture(width, height, outlines, np.empty((0, 2)))
