"""A report from Python, without a command."""

import json

import pytest
from evalkit import ReportJob, make_report
from posecore.bop import write_results


@pytest.mark.slow
def test_a_report_is_made_from_python(dataset, perfect, tmp_path):
    write_results(tmp_path / "initial.csv", perfect, {"dataset": str(dataset.root), "method": "initial"})
    write_results(tmp_path / "refined.csv", perfect, {"dataset": str(dataset.root), "method": "ours"})
    announced = []

    def on_file(name, total):
        announced.append((name, total, []))
        return announced[-1][2].append

    results = (tmp_path / "refined.csv", tmp_path / "initial.csv")
    report = make_report(ReportJob(results=results, out=tmp_path / "report", worst=0), on_file)
    assert [(name, total, sum(done)) for name, total, done in announced] == [
        ("initial", len(perfect), len(perfect)),
        ("refined", len(perfect), len(perfect)),
    ]
    assert [item["name"] for item in report.summary["against_initial"]] == ["refined"]
    assert json.loads(report.summary_file.read_text()) == report.summary
    assert all(file.is_file() for file in (report.page, report.table, *report.tables))
