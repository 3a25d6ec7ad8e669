# SPDX-License-Identifier: Apache-2.0
"""Pages in a real browser: what people see, on a desk and on a telephone, by day and by night.

Fails, and says how to install one, where there is no browser.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.evaluation.pictures import write_video
from accerl_lerobot.report.config import ReportConfig
from accerl_lerobot.report.page import write_report
from tests.report.browser import Browser
from tests.report.folders import HOSTILE, dreaming, dreams, metaworld, write_run, write_world_model

SIZES = """[...document.querySelectorAll('.plot svg')].map(svg => {
  const [box, drawn] = [svg, svg.querySelector('path:not(.grid)')].map(it => it.getBoundingClientRect());
  return [box.width, box.height, drawn.width];
})"""
LUMINANCE = """(() => {
  const [r, g, b] = getComputedStyle(document.body).backgroundColor.match(/[0-9.]+/g).map(Number);
  return (r + g + b) / 3;
})()"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser") / "profile") as started:
        yield started


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A page of each kind, of runs whose every text is hostile and long."""
    root = tmp_path_factory.mktemp("pages")
    task = f"{HOSTILE}-{'long' * 40}"
    config = metaworld(job_name=HOSTILE)
    run = write_run(root / f"run {'x' * 60}", config=config, tasks=(task, "door-open-v3"))
    frames = [np.full((64, 64, 3), shade, np.uint8) for shade in range(0, 250, 10)]
    write_video(run / "before_after.mp4", [[frames]], fps=20)
    dreamt = write_run(root / "dreams", config=dreaming(), rollout=dreams(), finished=False)
    made = {
        "run": (str(run),),
        "dreams": (str(dreamt),),
        "world model": (str(write_world_model(root / "model")),),
        "comparison": (str(run), str(dreamt), *(str(write_run(root / f"more{i}")) for i in range(8))),
    }
    return {
        name: write_report(ReportConfig(runs=runs, output=str(root / f"{name}.html")), CONFIGS)
        for name, runs in made.items()
    }


KINDS = ("run", "dreams", "world model", "comparison")


@pytest.mark.parametrize("width", [375, 1280])
@pytest.mark.parametrize("kind", KINDS)
def test_it_loads_without_a_complaint_or_a_request_and_fits(
    browser: Browser, pages: dict[str, Path], kind: str, width: int
) -> None:
    browser.open(pages[kind], width=width)
    assert browser.complaints() == [] and browser.requests() == []
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate("document.title").endswith("accerl report")  # hostile text would have changed it
    sizes = browser.evaluate(SIZES)
    assert len(sizes) >= 2
    for across, high, drawn in sizes:
        assert across > 200 and high > 100 and drawn > 0.2 * across


@pytest.mark.parametrize("dark", [False, True])
def test_it_is_light_by_day_and_dark_by_night(
    browser: Browser, pages: dict[str, Path], tmp_path: Path, dark: bool
) -> None:
    browser.open(pages["run"], dark=dark)
    assert (browser.evaluate(LUMINANCE) < 60) is dark and (browser.evaluate(LUMINANCE) > 200) is not dark
    browser.screenshot(tmp_path / "shot.png")
    picture = np.asarray(Image.open(tmp_path / "shot.png").convert("L"), dtype=np.float64)
    assert picture.shape[1] == 1280 and picture.shape[0] > 2000
    assert bool(picture.mean() < 80) is dark and picture.std() > 8


def test_text_can_be_read_by_day_and_by_night(browser: Browser, pages: dict[str, Path]) -> None:
    """Contrast of at least 4.5 for text, 3 for lines, as WCAG 2.2 asks (1.4.3, 1.4.11)."""
    for dark in (False, True):
        browser.open(pages["run"], dark=dark)
        names = ["ground", "card", "ink", "soft", "accent", "good", "good-ground", "bad", "bad-ground"]
        colours = browser.evaluate(
            f"({names + [f'c{i}' for i in range(8)]!r}).map(name => "
            "[name, getComputedStyle(document.documentElement).getPropertyValue('--' + name)])"
        )
        lum = {name: luminance(value.strip()) for name, value in colours}
        for ink, ground in (
            ("ink", "ground"), ("ink", "card"), ("soft", "ground"), ("soft", "card"), ("accent", "ground"),
            ("good", "good-ground"), ("bad", "bad-ground"),
        ):  # fmt: skip
            assert contrast(lum[ink], lum[ground]) >= 4.5, (dark, ink, ground)
        for i in range(8):
            assert contrast(lum[f"c{i}"], lum["card"]) >= 3, (dark, i)


def test_values_show_under_the_pointer(browser: Browser, pages: dict[str, Path]) -> None:
    browser.open(pages["run"])
    x, y, across, high = browser.evaluate(
        "(() => { const box = document.querySelector('.plot').getBoundingClientRect();"
        "return [box.x, box.y, box.width, box.height]; })()"
    )
    tip = "(tip => tip.hidden ? null : tip.innerText)(document.querySelector('.tip'))"
    assert browser.evaluate(tip) is None
    browser.point(x + across - 12, y + high / 2)  # the evaluation after training
    shown = browser.evaluate(tip)
    assert "4,000 env steps" in shown and "evaluation, 95 % Wilson: 90 % (82.6 % to 94.5 %)" in shown
    browser.point(2, 2)
    assert browser.evaluate(tip) is None


def test_values_show_under_the_arrow_keys(browser: Browser, pages: dict[str, Path]) -> None:
    browser.open(pages["run"])
    browser.evaluate("document.querySelector('.plot').focus()")
    for key in ("ArrowRight", "ArrowRight"):
        browser.call("Input.dispatchKeyEvent", type="keyDown", key=key)
        browser.call("Input.dispatchKeyEvent", type="keyUp", key=key)
    assert "2,500 env steps" in browser.evaluate("document.querySelector('.tip').innerText")


def test_the_video_plays(browser: Browser, pages: dict[str, Path]) -> None:
    browser.open(pages["run"])
    browser.evaluate("document.querySelector('video').scrollIntoView()")
    played: Any = browser.evaluate(
        "new Promise(done => { const video = document.querySelector('video'); const started = Date.now();"
        "const look = () => video.currentTime > 0.1 || Date.now() - started > 30000"
        " ? done(video.currentTime) : setTimeout(look, 50); look(); })"
    )
    assert played > 0.1


def test_the_page_may_run_nothing_but_its_own_script(
    browser: Browser, pages: dict[str, Path], tmp_path: Path
) -> None:
    """Even what somebody puts into the file later: the browser was told which script is the page's."""
    html = pages["run"].read_text()
    spoilt = tmp_path / "spoilt.html"
    spoilt.write_text(
        html.replace(
            "<main>", "<main><script>document.title = 'owned'</script><img src=http://127.0.0.1:9/x>"
        )
    )
    browser.open(spoilt)
    assert browser.evaluate("document.title").endswith("accerl report")
    assert len(browser.complaints()) >= 2  # which also shows that complaints are heard


def luminance(colour: str) -> float:
    """Relative luminance of ``#rrggbb``, as WCAG defines it."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a: float, b: float) -> float:
    """Between two luminances."""
    return (max(a, b) + 0.05) / (min(a, b) + 0.05)
