"""The report: one file, nothing from outside, problems first, and true to the numbers it is given."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from bricktrack_common.arrays import rows_of
from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.errors import StorageError
from bricktrack_common.run_manifest import ClocksSection
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.reporting.report import flag_meanings, recording_date, render_report, write_report
from bricktrack_host.results.run_summary import key_figures, verdict

from .test_results import example


class Collector(HTMLParser):
    """Collect what a browser would fetch or run, the text, and unclosed tags."""

    VOID = frozenset({"meta", "img", "br", "link", "input", "hr"})

    def __init__(self):
        super().__init__()
        self.fetched, self.tags, self.text, self.open = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action")]
        assert not any(k.startswith("on") for k, _ in attrs)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "title"):
            self.text.append(data)


def parsed(html):
    collector = Collector()
    collector.feed(html)
    assert collector.open == []
    return collector, " ".join(" ".join(collector.text).split())


def changed(manifest, **new):
    return type(manifest)(**{f: getattr(manifest, f) for f in manifest.__struct_fields__} | new)


@pytest.fixture(scope="module")
def result():
    return example.example_result()


@pytest.fixture(scope="module")
def nothing(result):
    """Return a run of which only the frame stamps are left; its report is made quickly."""
    optical = result.optical
    return replace(
        result,
        optical=replace(
            optical,
            R_camera_brick=np.full_like(optical.R_camera_brick, np.nan),
            t_camera_brick_mm=np.full_like(optical.t_camera_brick_mm, np.nan),
            covariance=np.full_like(optical.covariance, np.nan),
            residual_px=np.full_like(optical.residual_px, np.nan),
            flags=np.full_like(optical.flags, int(PoseFlag.NO_POSE)),
        ),
        fused={}, edge_index=np.empty(0, np.int64), edge_fit=None, imu=None, rest=None, alignment={},
        calibration={}, problems=("the trigger never came",),
        manifest=changed(result.manifest, trigger=type(result.manifest.trigger)(pin="x", t0_ns=None), camera=None,
                         imus=[], clocks=ClocksSection()),
    )  # fmt: skip


@pytest.fixture(scope="module")
def full(result):
    return render_report(result, example.example_extras(result))


def test_report_needs_nothing_from_outside(full):
    collector, _ = parsed(full)
    assert "script" not in collector.tags
    assert "link" not in collector.tags
    assert all(v.startswith(("data:image/", "#")) for v in collector.fetched)
    assert "@import" not in full
    assert "url(" not in full
    anchors = {v[1:] for v in collector.fetched if v.startswith("#")}
    assert anchors <= set(re.findall(r' id="([a-z]+)"', full))
    assert collector.tags.count("img") == 13  # motion 4, truth 1, residuals 2, pictures 3, and one each of 3
    assert len(full) < 8_000_000


def test_simulated_is_said_and_only_then(nothing, full):
    assert "SIMULATED" in parsed(full)[1]
    assert "SIMULATED" in parsed(render_report(nothing))[1]
    real = replace(nothing, manifest=changed(nothing.manifest, simulated=False))
    assert "SIMULATED" not in parsed(render_report(real))[1]


def test_problems_come_first_in_words(result, full):
    text = parsed(full)[1]
    assert text.index("2 frames were dropped by the camera") < text.index("Peak displacement")
    assert "1 of 3000 edges of the square wave was missed" in text
    good = replace(result, problems=(), edge_fit=None)
    line, problems = verdict(good, key_figures(good))
    assert line == "No problem found: 452 of 462 frames gave a pose (97.8 %)."
    assert problems == []


def test_key_figures_are_those_of_the_motion_put_in(result):
    f = key_figures(result)
    assert f.n_frames_dropped == 2
    assert f.n_poses == 452
    assert f.residual_rms_px == pytest.approx(0.06 * np.sqrt(2), rel=0.05)
    # From 8.4 s to 8.75 s, and the neighbouring frames; the two dropped frames are a second gap.
    assert len(f.dropouts_ns) == 2
    longest_s = (f.dropouts_ns[:, 1] - f.dropouts_ns[:, 0]).max() / 1e9
    assert 0.35 < longest_s < 0.35 + 2 * 0.034
    assert len(f.impacts_ns) == 1
    assert abs(f.impacts_ns[0] - example.T0_NS - example.IMPACT_S * 1e9) < 6e6
    np.testing.assert_allclose(f.sd_mm, 0.4 * example.SD_MM, rtol=1e-6)


def test_every_flag_is_counted_and_explained_in_the_words_of_its_definition(full):
    text = parsed(full)[1]
    for kind in (PoseFlag, LedFlag):
        meanings = flag_meanings(kind)
        assert set(meanings) == {f.name for f in kind if int(f)}
    assert "Touches the picture's border" in text
    assert re.search(r"no pose 10 No pose could be had", text)


@pytest.mark.parametrize(
    ("clocks", "words"),
    [
        (ClocksSection(), "not logged"),
        (
            ClocksSection(arm=ClockTriplet(monotonic_ns=1, boottime_ns=1, realtime_ns=86_400 * 10**9)),
            "not set",
        ),
        (
            ClocksSection(
                trigger=ClockTriplet(monotonic_ns=1, boottime_ns=1, realtime_ns=1_790_000_000 * 10**9)
            ),
            "21 September 2026, 14:13:20 UTC",
        ),
    ],
)
def test_date_is_the_units_or_is_said_to_be_none(result, clocks, words):
    assert words in recording_date(replace(result, manifest=changed(result.manifest, clocks=clocks)))


def test_text_from_outside_is_escaped(nothing):
    nasty = replace(
        nothing, problems=("<script>alert(1)</script>",), calibration={"date": "<img src=http://x>"}
    )
    html = render_report(nasty)
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    assert "<img src=http" not in html


def test_a_run_of_which_nothing_could_be_had_still_gives_a_report(nothing):
    text = parsed(render_report(nothing))[1]
    assert "Not usable" in text
    assert "no pose could be had from any frame" in text
    assert "nan" not in re.findall(r"[a-z]+", text)


def test_the_same_result_gives_the_same_report(nothing):
    assert render_report(nothing) == render_report(nothing)


def test_write_replaces_the_file_whole_and_says_why_it_cannot(result, tmp_path, monkeypatch):
    monkeypatch.setattr("bricktrack_host.reporting.report.render_report", lambda *_: "<html>")
    write_report(result, tmp_path / "report.html")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(StorageError, match="cannot be written"):  # there, a file is in the way
        write_report(result, tmp_path / "report.html" / "report.html")


def test_flags_of_the_whole_run_become_words(result):
    optical = result.optical
    flags = optical.flags | int(PoseFlag.LED_PROFILE_UNKNOWN)
    flags[:7] |= int(PoseFlag.UNCOVERED)
    blurred = replace(result, optical=replace(optical, flags=flags, residual_px=optical.residual_px * 20))
    _, problems = verdict(blurred, key_figures(blurred))
    said = " ".join(problems)
    assert f"LEDs lie {20 * key_figures(result).residual_rms_px:.2f} px" in said
    assert "no profile of these LEDs" in said and "never fitted" not in said
    assert "7 poses use rays" in said


def test_frames_that_a_camera_dropped_are_named(result):
    def said_of(frames):
        part = replace(
            result, observations=rows_of(result.observations, frames), optical=rows_of(result.optical, frames)
        )
        return " ".join(verdict(part, key_figures(part))[1])

    whole = np.arange(60)
    assert "the camera dropped" not in said_of(whole)
    assert "the camera dropped 10 of 60 frames" in said_of(whole[(whole < 30) | (whole >= 40)])


def test_poses_that_the_fusion_did_not_believe_count_as_time_without_a_pose(result):
    track = result.fused["imu"]
    flags = track.flags.copy()
    flags[1000:1010] |= int(PoseFlag.DROPOUT)
    f = key_figures(replace(result, fused={"imu": replace(track, flags=flags)}))
    assert len(f.dropouts_ns) == 3
    assert [track.t_ns[1000], track.t_ns[1009]] in f.dropouts_ns.tolist()
