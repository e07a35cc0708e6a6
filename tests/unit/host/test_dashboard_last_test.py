"""The last test on the page: the newest one is found, its verdicts are told, and only reports are handed out."""

import os

import pytest
from small_lab import BRICK, UNITS, invented_run

from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.dashboard.last_test import (
    assembly_rows,
    find_last_test,
    report_address,
    served_report,
    unit_rows,
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A laboratory whose test shake-12 is of two units; only one of their runs has a report."""
    lab = tmp_path_factory.mktemp("lab")
    results = {}
    for unit in UNITS:
        invented_run(lab / "runs" / f"{unit}_0001_shake", unit)
        results[unit] = lab / "runs" / f"{unit}_0001_shake" / "results"
    (results["b7-1"] / "report.html").write_text("the run")
    folder = lab / "tests" / "shake-12" / "combined"
    combine_test("shake-12", results, [BRICK], folder)
    (folder / "report.html").write_text("the test")
    return lab


def test_there_may_be_no_test_yet(tmp_path):
    assert find_last_test(tmp_path / "tests") is None


def test_units_and_assemblies_have_a_row_each(lab):
    last = find_last_test(lab / "tests")
    assert (last.name, last.error) == ("shake-12", "")
    rows = unit_rows(last, lab)
    assert [row["unit"] for row in rows] == list(UNITS)
    assert rows[0]["edges"] == "same samples as the others"
    # What scripts/example_report.py invents: 462 frames, 10 of them without a pose, 2 dropped before.
    assert rows[0]["poses"] == "452 of 462"
    assert "2 frames were dropped" in str(rows[0]["verdict"])
    b, c = assembly_rows(last.summary)
    assert (b["assembly"], b["component"], c["component"]) == ("brick-7", "B", "C")
    assert float(str(c["peak_mm"])) > float(str(b["peak_mm"])) > 0.0
    assert b["loops"] == "-"  # two views of three components close none


def test_reports_have_an_address_where_there_is_one(lab):
    last = find_last_test(lab / "tests")
    assert report_address(lab, last.report) == "/lab/tests/shake-12/combined/report.html"
    first, second = unit_rows(last, lab)
    assert first["report"] == "/lab/runs/b7-1_0001_shake/results/report.html"
    assert second["report"] is None


def test_nothing_but_reports_of_the_laboratory_is_handed_out(lab, tmp_path):
    assert served_report(lab, "tests/shake-12/combined/report.html").read_text() == "the test"
    (tmp_path / "report.html").write_text("not the laboratory's")
    outside = os.path.relpath(tmp_path / "report.html", lab)
    for path in (outside, str(tmp_path / "report.html"), "tests/shake-12/combined/test.json", "tests", "",
                 "tests/../../report.html", "runs/b7-2_0001_shake/results/report.html"):  # fmt: skip
        assert served_report(lab, path) is None, path


def test_the_newest_test_counts_and_a_damaged_one_says_so(lab, tmp_path):
    tests = tmp_path / "tests"
    for i, name in enumerate(("old", "new")):
        folder = tests / name / "combined"
        folder.mkdir(parents=True)
        (folder / "test.json").write_text("{}")
        os.utime(folder / "test.json", ns=(i + 1, i + 1))
    last = find_last_test(tests)
    assert last.name == "new" and last.summary is None
    assert "test.json" in last.error
    assert unit_rows(last, tmp_path) == []
