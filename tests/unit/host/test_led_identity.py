import numpy as np

from bricktrack_host.tracking.identity import led_identity

from .test_identity_newcomers import BRICK, CAMERA, COLLAR, STEP_NS, N, known_run


def test_an_impact_within_a_frame_costs_no_search_from_nothing(monkeypatch):
    """The brick is hit in frame 10: it moves at 0.3 m/s from the middle row on, before hardly."""
    blobs = known_run()[0].blobs
    v = blobs[10].uv_px[:, 1]
    late_s = (v - 0.5 * (CAMERA.sensor_mode.height - 1)) * CAMERA.sensor_mode.line_time_ns * 1e-9
    px_per_mm = 8.0  # about: the brick is some 130 mm away
    blobs[10].uv_px[:6, 0] += (300.0 * px_per_mm * np.maximum(late_s, 0.0))[:6]
    searched = []
    search = led_identity.search_correspondence

    def counted(picture, *args, **options):
        searched.append(next(i for i, b in enumerate(blobs) if b is picture))
        return search(picture, *args, **options)

    monkeypatch.setattr(led_identity, "search_correspondence", counted)
    stamps = np.arange(N) * STEP_NS
    found = led_identity.identify_run(blobs, stamps, CAMERA, BRICK, radius_px=34.0, collar_mm=COLLAR)
    assert (found.blob_of_led == [0, 1, 2, 3, 4, 5, -1]).all()
    assert searched == [0]
