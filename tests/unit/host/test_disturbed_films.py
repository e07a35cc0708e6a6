"""The cards and lamps of `scripts/bench_covered.py` hide and light what they say."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def films(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "scripts"))
    monkeypatch.delitem(sys.modules, "disturbed_films", raising=False)
    return importlib.import_module("disturbed_films")


def lit_disc(radius_px=37.0):
    v, u = np.mgrid[:400, :400]
    return np.where(np.hypot(u - 200, v - 200) <= radius_px, 200, 20).astype(np.uint8)


@pytest.mark.parametrize("angle_deg", [0, 90, 215])
def test_a_card_whose_edge_is_in_the_middle_hides_half_of_an_led(films, angle_deg):
    luma = lit_disc()
    lit = (luma == 200).sum()
    films.draw_card(luma, np.array([200.0, 200.0]), np.radians(angle_deg), 0.0, light=0.004, soft_px=2.0)
    assert (luma > 150).sum() == pytest.approx(lit / 2, rel=0.03)  # the edge's pixels are in between
    ahead = np.rint(200 + 20 * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))]))
    assert luma[int(ahead[1]), int(ahead[0])] < 40


def test_a_lamp_darkens_nothing_and_ends_at_the_border(films):
    luma = lit_disc()
    before = luma.copy()
    films.draw_lamp(luma, np.array([390.0, 200.0]), 30.0, light=0.4)
    assert (luma.astype(int) >= before.astype(int) - 1).all()  # one code of rounding through linear light
    assert luma[200, 395] > 100
