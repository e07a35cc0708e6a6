"""The cards and lamps of `scripts/bench_covered.py` hide and light what they say."""

import disturbed_films
import numpy as np
import pytest


def lit_disc(radius_px=37.0):
    v, u = np.mgrid[:400, :400]
    return np.where(np.hypot(u - 200, v - 200) <= radius_px, 200, 20).astype(np.uint8)


@pytest.mark.parametrize("angle_deg", [0, 90, 215])
def test_a_card_whose_edge_is_in_the_middle_hides_half_of_an_led(angle_deg):
    luma = lit_disc()
    lit = (luma == 200).sum()
    disturbed_films.draw_card(
        luma, np.array([200.0, 200.0]), np.radians(angle_deg), 0.0, light=0.004, soft_px=2.0
    )
    assert (luma > 150).sum() == pytest.approx(lit / 2, rel=0.03)  # the edge's pixels are in between
    ahead = np.rint(200 + 20 * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))]))
    assert luma[int(ahead[1]), int(ahead[0])] < 40


def test_a_lamp_darkens_nothing_and_ends_at_the_border():
    luma = lit_disc()
    before = luma.copy()
    disturbed_films.draw_lamp(luma, np.array([390.0, 200.0]), 30.0, light=0.4)
    assert (luma.astype(int) >= before.astype(int) - 1).all()  # one code of rounding through linear light
    assert luma[200, 395] > 100
