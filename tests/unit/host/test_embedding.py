"""Pictures in a page: marks lie over the pixels that they mean."""

import base64
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from bricktrack_host.reporting.embedding import embed_overlay
from bricktrack_host.reporting.page_picture import page_picture
from bricktrack_host.reporting.plots import FrameOverlay


def svg_of(embedded):
    head, data = embedded.uri.split(",", 1)
    assert head == "data:image/svg+xml;base64"
    return base64.b64decode(data).decode()


@pytest.mark.parametrize("shape", [(1080, 1920), (120, 160, 3)])
def test_overlay_marks_are_at_their_pixels_over_the_whole_picture(shape):
    image = np.zeros(shape, np.uint8)
    image[10:20, 30:40] = 250
    overlay = FrameOverlay(
        "frame 3, 0.1 s & more", page_picture(image),
        np.array([[34.5, 14.5], [np.nan, np.nan]]), np.array([[35.0, 15.0], [100.0, 60.0]]),
    )  # fmt: skip
    embedded = embed_overlay(overlay)
    assert embedded.caption == overlay.title
    root = ET.fromstring(svg_of(embedded))
    space = {"s": "http://www.w3.org/2000/svg"}
    assert root.get("viewBox") == f"-0.5 -0.5 {shape[1]} {shape[0]}"
    circles = root.findall(".//s:circle", space)
    assert [(c.get("cx"), c.get("cy")) for c in circles] == [("34.5", "14.5")]
    assert root.find(".//s:path", space).get("d").count("M") == 4  # two crosses
    picture = root.find("s:image", space)
    assert [picture.get(k) for k in ("x", "y", "width", "height")] == [
        "-0.5",
        "-0.5",
        str(shape[1]),
        str(shape[0]),
    ]
