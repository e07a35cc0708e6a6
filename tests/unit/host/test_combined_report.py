"""The report of a test: links that lead somewhere, problems first, numbers those of the tables."""

import re
from urllib.parse import unquote, urlparse

import msgspec
import numpy as np
import pytest
from small_lab import BRICK, UNITS, example, invented_run

from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_host.assemblies.combined_summary import read_components, read_test
from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting.combined_charts import dropout_spans, impact_instants, spans
from bricktrack_host.reporting.combined_report import (
    CombinedTest,
    read_combined_test,
    render_combined_report,
    verdict,
    write_combined_report,
)

from .test_report import parsed


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A combined test of two units (invented, simulated), in a folder whose name needs quoting in a link."""
    lab = tmp_path_factory.mktemp("lab")
    results = {}
    for unit in UNITS:
        run = lab / "runs 100 %" / f"{unit}_0001_shake"
        invented_run(run, unit)
        (run / "results" / "report.html").write_text("a run's report")
        results[unit] = run / "results"
    test = lab / "tests" / "shake-12"
    test.parent.mkdir()
    combine_test("shake-12", results, [BRICK], test, also=write_combined_report)
    return test


@pytest.fixture(scope="module")
def html(folder):
    return (folder / "report.html").read_text()


def test_the_page_is_whole_and_needs_nothing_from_outside(html):
    collector, text = parsed(html)
    assert "script" not in collector.tags
    assert "SIMULATED" in text
    # One chart for each component but the base.
    assert collector.tags.count("img") == 2
    outside = [v for v in collector.fetched if not v.startswith(("data:image/", "#"))]
    assert len(outside) == 2, "nothing but the links to the two runs"
    anchors = {v[1:] for v in collector.fetched if v.startswith("#")}
    assert anchors == set(re.findall(r'<section id="([^"]+)"', html))


def test_links_lead_to_the_runs_reports(folder, html):
    links = [v for v in parsed(html)[0].fetched if "report.html" in v]
    for link in links:
        assert not urlparse(link).scheme, "a relative link survives the move of the whole archive"
        assert (folder / unquote(link)).read_text() == "a run's report"


def test_a_page_elsewhere_has_no_links_that_lead_nowhere(folder, tmp_path):
    page = write_combined_report(folder, tmp_path / "mailed.html")
    assert not [v for v in parsed(page.read_text())[0].fetched if "report.html" in v]
    assert "b7-1_0001_shake" in parsed(page.read_text())[1]


def test_the_peaks_are_those_of_the_table_between_first_and_last_pose(folder, html):
    table = read_components(folder, "brick-7").to_pydict()
    for component, peak_mm in read_test(folder).assemblies[0].peak_mm.items():
        largest = max(
            sum(table[f"d{c}_mm"][i] ** 2 for c in "xyz") ** 0.5
            for i in range(len(table["component"]))
            if table["component"][i] == component and not table["flags"][i] & PoseFlag.EXTRAPOLATED
        )
        assert peak_mm == pytest.approx(largest, rel=1e-9)
        assert f"{largest:.3f}" in parsed(html)[1]


def test_the_invented_dropout_and_impact_are_marked_where_they_were_put(folder):
    test = read_combined_test(folder)
    history = test.motions["brick-7"]["B"]
    assert history.t_s[0] == pytest.approx(history.sample[0] / 200.0)
    shaded = dropout_spans(history)
    first, last = example.DROPOUT_S
    period_s = example.PERIOD_NS / 1e9
    # The example flags what lies within its dropout; a sample comes every 5 ms.
    inside = [span for span in shaded if span[0] < last and span[1] > first]
    assert len(inside) == 1
    np.testing.assert_allclose(inside[0], [first, last], atol=period_s)
    np.testing.assert_allclose(impact_instants(history), [example.IMPACT_S], atol=period_s)


def test_spans_are_the_stretches_of_set_samples():
    t = np.array([0.0, 1, 2, 3, 4, 5])
    mask = np.array([True, True, False, False, True, False])
    assert spans(t, mask).tolist() == [[0, 1], [4, 4]]
    assert spans(t, ~np.ones(6, bool)).shape == (0, 2)


def test_problems_come_first_and_set_the_mood(folder):
    test = read_combined_test(folder)
    calm = [msgspec.structs.replace(unit, problems=[]) for unit in test.summary.units]
    assert verdict(msgspec.structs.replace(test.summary, units=calm)) == (
        "No problem found: 2 of 2 units on the same samples, 2 components seen from their base.", "good",
    )  # fmt: skip
    alone = msgspec.structs.replace(test.summary, units=calm, assemblies=[])
    assert verdict(alone) == ("No problem found: 2 of 2 units on the same samples.", "good")
    doubted = [msgspec.structs.replace(calm[0], problems=["video: cut"]), calm[1]]
    line, mood = verdict(msgspec.structs.replace(test.summary, units=doubted))
    assert (line.endswith("1 unit with points of its own."), mood) == (True, "care")
    told = msgspec.structs.replace(test.summary, problems=["b7-2: <its> first edge is unknown"])
    text = parsed(render_combined_report(CombinedTest(told, test.motions)))[1]
    assert "1 point to read first" in text
    assert text.index("b7-2: <its> first edge is unknown") < text.index("Largest displacement")
    nothing = [
        msgspec.structs.replace(a, chains={}, table=None, problems=["no view"]) for a in told.assemblies
    ]
    lost = msgspec.structs.replace(told, assemblies=nothing)
    assert verdict(lost)[1] == "bad"
    assert "no view" in parsed(render_combined_report(CombinedTest(lost, {"brick-7": {}})))[1]


def test_what_each_run_is_worth_stands_in_the_summary(folder, html):
    unit = read_test(folder).units[0]
    assert unit.figures["frames"] == 462
    assert unit.figures["poses"] == 452
    assert unit.figures["impacts"] == 1
    assert "452 of 462" in parsed(html)[1]
    assert any("2 frames were dropped" in problem for problem in unit.problems)
    told = {w["witness"]: w["samples"] for w in read_test(folder).units[1].witnesses}
    assert told["motion"] == pytest.approx(0.0, abs=0.3)


def test_a_folder_that_is_no_test_and_a_page_that_cannot_be_written_are_said(folder, tmp_path):
    with pytest.raises(RunFormatError, match="bricktrack combine"):
        write_combined_report(tmp_path)
    with pytest.raises(StorageError, match="cannot be written"):
        write_combined_report(folder, tmp_path / "missing" / "report.html")
