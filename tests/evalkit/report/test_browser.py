"""Pages of `evalkit report` and `evalkit diff` in a real browser: nothing fails, nothing is fetched, tables sort."""

import shutil
from dataclasses import replace

import pytest
from click.testing import CliRunner
from evalkit.cli import main
from posecore import se3
from posecore.bop import BopDataset, read_results, write_results

from .browser import Browser, find_chromium

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_chromium() is None, reason="no Chromium on the PATH (Debian: chromium)"),
]
BODY = "tbody:not(.total) tr"
TABLE = (
    f"[...document.querySelectorAll('[aria-label^=\"By \"] table')].find(t => t.querySelectorAll('{BODY}').length > 2)"
)
NUMBER = "cell => parseFloat((cell.dataset.value ?? cell.textContent).replace('\u2212', '-'))"


def run(*arguments):
    result = CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="module")
def pages(tmp_path_factory, dataset_path):
    """A report and a comparison of starts with the same moved half way to the truth."""
    work = tmp_path_factory.mktemp("pages")
    shutil.copytree(dataset_path, work / "toys")
    initial_poses = work / "start.csv"
    run("perturb", "--dataset", work / "toys", "--out", initial_poses, "--angles", "5,10,20", "--translations", "0.1")
    dataset, better = BopDataset(work / "toys"), []
    for start in read_results(initial_poses):
        gt = next(gt for gt in dataset.gt(start.scene_id, start.im_id) if gt.obj_id == start.obj_id).T_cam_obj
        dR, dt = se3.update_between(start.T_cam_obj, gt)
        half = se3.rotation_from_rotvec(se3.rotvec_from_rotation(dR) / 2)
        better.append(replace(start, T_cam_obj=se3.apply_update(start.T_cam_obj, half, dt / 2)))
    lines = [start.line for start in read_results(initial_poses)]
    sidecar = {"method": "half", "init": "start.csv", "initial_lines": lines}
    write_results(work / "half.csv", better, sidecar)
    named = ("--dataset", work / "toys")
    run("report", *named, "--results", initial_poses, "--results", work / "half.csv", "--out", work / "report")
    run("diff", initial_poses, work / "half.csv", *named, "--html", work / "diff.html")
    return work / "report" / "index.html", work / "diff.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.mark.parametrize("which", [0, 1], ids=["report", "diff"])
@pytest.mark.parametrize("width_px", [360, 1440])
def test_a_page_opens_without_a_complaint_at_any_width(browser, pages, which, width_px):
    browser.open(pages[which], width_px)
    assert browser.errors == []
    assert browser.requests in ([], [pages[which].as_uri()])  # the file itself and nothing else
    assert browser.evaluate("document.documentElement.scrollWidth") <= width_px  # wide tables scroll inside
    assert browser.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert browser.evaluate("document.querySelectorAll('svg').length") > 0 or which == 1


def test_no_table_scrolls_sideways_on_a_usual_screen(browser, pages):
    browser.open(pages[0], 1280)
    browser.evaluate("document.querySelectorAll('details').forEach(details => details.open = true)")
    widths = browser.evaluate(
        "[...document.querySelectorAll('.scroll')].map(e => [e.ariaLabel, e.scrollWidth, e.clientWidth])"
    )
    assert len(widths) > 12
    assert [line for line in widths if line[1] > line[2]] == []


def test_pictures_and_plots_come_before_words_and_words_before_tables(browser, pages):
    browser.open(pages[0])
    tops = [
        browser.evaluate(f"document.querySelector('main {part}').getBoundingClientRect().top")
        for part in ("article.case img", ".plots svg", ".words", "table")
    ]
    assert tops == sorted(tops)
    assert tops[0] < 500  # on the first screen
    headings = browser.evaluate("[...document.querySelectorAll('main section:first-of-type h3')].map(h => h.innerText)")
    assert [text.split(":")[0] for text in headings if not text.startswith("Scene")] == ["Typical", "Worst"]
    assert browser.evaluate("document.querySelectorAll('main section:first-of-type article').length") == 6


def test_a_click_on_a_heading_sorts_and_another_turns_it_round(browser, pages):
    browser.open(pages[0])
    last = f"[...{TABLE}.querySelectorAll('{BODY}')].map(row => ({NUMBER})([...row.cells].at(-1)))"
    button = f"[...{TABLE}.tHead.rows[{TABLE}.tHead.rows.length - 1].cells].at(-1).querySelector('button')"
    values = browser.evaluate(last)
    assert len(set(values)) > 1 and values not in (sorted(values), sorted(values, reverse=True))
    browser.evaluate(f"{button}.click()")
    assert browser.evaluate(last) == sorted(values)
    browser.evaluate(f"{button}.click()")
    assert browser.evaluate(last) == sorted(values, reverse=True)


def test_without_scripts_the_page_still_reads(browser, pages):
    browser.open(pages[0], scripts=False)
    assert browser.errors == []
    browser.call("Emulation.setScriptExecutionDisabled", value=False)
    assert "VSS" in browser.evaluate("document.body.innerText")
