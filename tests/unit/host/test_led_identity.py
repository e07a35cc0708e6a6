import numpy as np

from bricktrack_host.tracking.identity import led_identity
from bricktrack_host.tracking.identity.run_identities import RunIdentities

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


def test_a_false_light_in_a_frame_that_moves_takes_no_leds_place():
    """LEDs 1 and 6 are hidden; in frame 10 the brick moves, and a light stands 12 px beside the latter."""
    run, R, t = known_run(hidden=1)
    v = run.blobs[10].uv_px[:, 1]
    late_s = (v - 0.5 * (CAMERA.sensor_mode.height - 1)) * CAMERA.sensor_mode.line_time_ns * 1e-9
    run.blobs[10].uv_px[:] += 150.0 * 8.0 * late_s[:, None]  # mm/s, and about px/mm
    run.blobs[10].uv_px[6, 0] += 12.0
    assigned = run.found.blob_of_led.copy()
    assigned[:, 6] = -1
    assigned[10, 6] = 6
    stamps = np.arange(N) * STEP_NS
    run = RunIdentities(run.blobs, stamps, CAMERA, BRICK, radius_px=34.0, collar_mm=COLLAR)
    verified = led_identity._verified(run, run.lights.of_leds(np.arange(N), assigned), R, t, np.arange(N))
    # Taken to be at rest, it fits best without LED 2, at a chi-square that a motion would excuse.
    assert np.flatnonzero(verified.kept[10]).tolist() == [0, 2, 3, 4, 5]
