"""The page of a report in a browser, by keyboard, and with many rows."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from problems.bench import parquet
from problems.bench.report import page
from problems.bench.rows import Failure, Job, Row
from problems.bench.store import Results

pytestmark = pytest.mark.usefixtures("toy_package")


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


BROWSER = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


def browse(path: Path, address: str, *options: str, timing: bool = False) -> subprocess.CompletedProcess[str]:
    quiet = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    quiet += [] if timing else ["--virtual-time-budget=3000"]  # a virtual clock measures nothing
    home = f"--user-data-dir={path.parent / 'browser'}"
    return subprocess.run(
        [str(CHROMIUM), *quiet, home, *options, f"{path.as_uri()}{address}"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip


@pytest.mark.browser
@BROWSER
def test_the_page_renders_without_console_messages(tmp_path: Path, shown: str) -> None:
    path, picture = tmp_path / "report.html", tmp_path / "report.png"
    path.write_text(shown, encoding="utf-8")
    done = browse(path, "", "--window-size=1300,2400", f"--screenshot={picture}")
    assert "CONSOLE" not in done.stderr
    from matplotlib.image import imread

    image = imread(picture)
    assert image.shape[:2] == (2400, 1300)
    assert len(np.unique(image[::5, ::5, :3].reshape(-1, 3), axis=0)) > 50  # text and pictures, no blank page


@pytest.mark.browser
@BROWSER
def test_filters_and_sorting_work_in_the_browser(tmp_path: Path, shown: str) -> None:
    path = tmp_path / "report.html"
    probe = """<script>
      const rows = () => [...document.querySelectorAll("tr.result:not([hidden])")];
      const off = document.querySelectorAll("svg .off").length;
      const filtered = rows().length;
      const box = document.querySelector('input[value="slow"]');
      box.checked = false; box.dispatchEvent(new Event("change"));
      const fewer = rows().length, address = location.hash;
      const table = document.querySelector("tr.result").closest("table");
      const column = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent === "error");
      const values = () => [...table.tBodies[0].rows].map((row) => row.cells[column].dataset.value);
      const button = table.tHead.rows[0].cells[column].querySelector("button");
      button.click(); const up = values(); button.click(); const down = values();
      document.title = JSON.stringify({off, filtered, fewer, address, up, down});
    </script>"""
    path.write_text(shown.replace("</body>", probe + "</body>"), encoding="utf-8")
    done = browse(path, "#no-method=kalman", "--dump-dom")
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title
    found = json.loads(html_unescape(title[1]))
    assert found["off"] > 0
    assert found["filtered"] == 32 - 6
    assert found["fewer"] == 32 - 6 - 12
    assert found["address"] == "#no-method=kalman&no-solver=slow"
    up = [float(value) for value in found["up"] if value != ""]
    assert up == sorted(up)
    assert [float(value) for value in found["down"] if value != ""] == up[::-1]
    assert found["up"][-1] == found["down"][-1] == ""  # missing values stay last


def html_unescape(text: str) -> str:
    from html import unescape

    return unescape(text)


@pytest.mark.browser
@BROWSER
def test_points_are_reached_by_the_arrow_keys(tmp_path: Path, shown: str) -> None:
    path = tmp_path / "report.html"
    probe = """<script>
      const figure = [...document.querySelectorAll("figure")].find((one) => one.querySelector(".point"));
      const told = [];
      const press = (key) => figure.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
      figure.focus();
      for (const key of ["ArrowRight", "ArrowRight", "ArrowLeft"]) {
        press(key);
        told.push(document.querySelector(".card").textContent);
      }
      const focused = document.activeElement === figure, shown = !document.querySelector(".card").hidden;
      press("Escape");
      const gone = document.querySelector(".card").hidden;
      const none = document.querySelector(".filters .none");
      none.click();
      const left = document.querySelectorAll("tr.result:not([hidden])").length;
      none.parentElement.querySelector(".all").click();
      const back = document.querySelectorAll("tr.result:not([hidden])").length;
      document.title = JSON.stringify({told, focused, shown, gone, left, back});
    </script>"""
    path.write_text(shown.replace("</body>", probe + "</body>"), encoding="utf-8")
    done = browse(path, "", "--dump-dom")
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title
    found = json.loads(html_unescape(title[1]))
    first, second, third = found["told"]
    assert first == third != second
    assert "error" in first or "distance" in first
    assert (found["focused"], found["shown"], found["gone"]) == (True, True, True)
    assert (found["left"], found["back"]) == (0, 32)


def large(rows: int, configurations: int) -> Results:
    """Generated results: rows of so many configurations in two scenarios, with curves, failures and warnings."""
    rng = np.random.default_rng(0)
    found = []
    facts = {
        "methods": ["mhe"],
        "settings": {"tolerance": 1e-6, "horizon": 5},
        "metrics": ["rmse", "bias"],
        "source": "",
    }
    curve_at = list(range(64))
    for number_of in range(rows):
        configuration, trial = number_of % configurations, number_of // configurations
        scenario = ("alpha", "beta")[configuration % 2]
        solver = ("osqp", "daqp", "proxqp", "piqp", "ipopt")[configuration // 2 % 5]
        settings = {"tolerance": 10.0 ** -(2 + configuration // 10 % 8), "horizon": configuration // 80}
        job = Job(scenario, "mhe", solver, settings, 0, trial)
        if number_of % 997 == 0:
            failure = Failure("ArithmeticError", f"diverged in step {number_of}", "Traceback\n" * 40)
            found.append(Row(job, failure=failure, status={"failed": 1}))
            continue
        time, error = rng.lognormal(-7), rng.lognormal()
        found.append(
            Row(
                job,
                metrics={"rmse": error, "bias": error / 3, "distance_to_reference": settings["tolerance"] * error},
                times={"compile": 0.1, "update": time / 2, "solve": time},
                steps=60,
                step_median=time / 60,
                step_p95=time / 30,
                step_max=time / 10,
                status={"solved": 58, "infeasible": 2},
                iterations=int(600 * error),
                residual=settings["tolerance"] / 2,
                curves={
                    "error": {"at": curve_at, "values": rng.lognormal(size=64).round(4).tolist(), "over": "time step"}
                },
                consistency={"nees": {"mean": 1.0, "inside": 0.95, "degrees": 3, "samples": 64}},
                wall=time * 2,
                cpu=time * 2,
                memory=2**20,
                warnings=[f"UserWarning: {number_of}"] if number_of % 500 == 0 else [],
            )
        )
    session = {
        "started": "2026-01-01T00:00:00+00:00",
        "plan": {"name": "large", "text": "", "seed": 0, "trials": rows // configurations, "time_limit": 10.0}
        | {"study": []},
        "scenarios": {name: facts for name in ("alpha", "beta")},
        "machine": {"processor": "p", "cores": 2, "system": "s", "python": "3", "workers": 1}
        | {"threads": {}, "versions": {}},
    }
    return Results(found, [session])


@pytest.mark.parametrize("configurations", [60, 3000])
def test_a_page_of_many_rows_holds_aggregates_only(configurations: int) -> None:
    text = page(large(6000, configurations))
    assert len(text.encode()) < 4 * 2**20
    assert text.count('class="point"') <= 3000
    assert text.count('<tr class="result"') <= 1000
    assert ("are shown, evenly chosen; the CSV has all" in text) == (configurations > 1000)


@pytest.mark.slow
@pytest.mark.browser
@BROWSER
@pytest.mark.parametrize("configurations", [1000, 50_000])
def test_a_hundred_thousand_rows_open_in_three_seconds(tmp_path: Path, configurations: int) -> None:
    path = tmp_path / "report.html"
    probe = """<script>addEventListener("load", () => {
      document.body.offsetHeight;  // everything is laid out
      document.title = JSON.stringify({milliseconds: performance.now(), rows: document.querySelectorAll("tr").length});
    });</script>"""
    results = large(100_000, configurations)
    parquet.write(tmp_path, results.rows, results.sessions)
    path.write_text(page(Results(*parquet.read(tmp_path))).replace("</body>", probe + "</body>"), encoding="utf-8")
    assert path.stat().st_size < 8 * 2**20
    done = browse(path, "", "--dump-dom", timing=True)
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title
    found = json.loads(html_unescape(title[1]))
    print(f"{configurations} configurations: {path.stat().st_size / 2**20:.1f} MiB, {found}")
    assert found["milliseconds"] < 3000
