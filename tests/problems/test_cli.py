"""The command line as people and programs meet it: exit codes, messages, one JSON object on standard output."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from problems.bench import plan as plan_module
from problems.cli.main import app
from problems.solvers.base import Status

pytestmark = pytest.mark.usefixtures("toy_package")

ROW_FIELDS = [
    "scenario",
    "method",
    "solver",
    "settings",
    "options",
    "metrics",
    "metrics_se",
    "time",
    "status",
    "reproduce",
]


def horizonet(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def answer(*words: str, code: int = 0) -> dict:
    result = horizonet(*words)
    assert result.exit_code == code, result.output
    return json.loads(result.stdout)


def test_solvers_lists_what_is_registered_and_what_to_install() -> None:
    found = {entry["name"]: entry for entry in answer("solvers", "--json")["solvers"]}
    assert found["swift"] == {
        "name": "swift", "available": True, "version": "1.2", "forms": ["quadratic"], "warm_start": True, "extra": None
    }  # fmt: skip
    assert found["slow"]["forms"] == ["nonlinear", "graph"]
    assert (found["absent"]["available"], found["absent"]["extra"]) == (False, "magic")
    assert 'pip install "horizonet[magic]"' in horizonet("solvers").stdout


def test_scenarios_show_settings_with_defaults() -> None:
    (toy,) = answer("scenarios", "toy", "--json")["scenarios"]
    assert toy == {
        "name": "toy",
        "methods": ["mean", "first", "kalman"],
        "settings": {"steps": 4, "tolerance": 1e-6, "mode": "calm", "offset": 0.0, "label": "1"},
        "metrics": ["error", "never"],
        "source": "made for the tests",
    }
    assert {"toy", "other"} <= {entry["name"] for entry in answer("scenarios", "--json")["scenarios"]}
    shown = horizonet("scenarios", "toy").stdout
    assert "number of steps" in shown
    assert "integer >= 1" in shown


@pytest.mark.serial
def test_run_prints_the_object_of_the_contract() -> None:
    found = answer(
        "run", "toy", "--solver", "swift", "--set", "tolerance=1e-3", "--trials", "3", "--seed", "5", "--json"
    )
    assert list(found) == ["scenario", "seed", "trials", "settings", "rows"]
    assert (found["scenario"], found["seed"], found["trials"]) == ("toy", 5, 3)
    assert found["settings"]["tolerance"] == 1e-3
    assert found["settings"]["steps"] == 4
    assert [row["method"] for row in found["rows"]] == ["mean", "first", "kalman"]
    assert [row["solver"] for row in found["rows"]] == ["swift", "swift", "none"]
    for row in found["rows"]:
        assert list(row) == ROW_FIELDS
        assert row["settings"] == found["settings"]
        assert row["metrics"]["never"] is None
        assert row["metrics_se"].keys() - {"distance_to_reference"} == {"error"}
        assert list(row["time"]) == ["compile", "setup", "update", "solve", "step_median", "step_p95"]
        assert list(row["status"]) == [status.value for status in Status]
        assert row["status"]["solved"] == 9


@pytest.mark.serial
def test_the_reproduce_line_gives_the_row_again(tmp_path: Path) -> None:
    options = ["--set", "tolerance=1e-3,1e-5", "--set", "label=a b", "--trials", "2", "--seed", "3"]
    rows = answer("bench", "toy", *options, "--out", str(tmp_path / "r"), "--json")["rows"]
    row = rows[-2]
    assert row["settings"]["tolerance"] == 1e-5
    import shlex

    again = answer(*shlex.split(row["reproduce"])[1:], "--json")["rows"]
    assert again == [row]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["run", "toi"], "did you mean toy"),
        (["run", "toy", "--method", "maen"], "did you mean mean"),
        (["run", "toy", "--solver", "swfit"], "did you mean swift"),
        (["run", "toy", "--set", "stesp=3"], "did you mean steps"),
        (["run", "toy", "--set", "steps"], "KEY=VALUE"),
        (["run", "toy", "--set", "steps=0"], "greater than or equal to 1"),
        (["run", "toy", "--trials", "0"], "trials"),
        (["run", "toy", "--solver", "absent"], 'pip install "horizonet[magic]"'),
        (["run", "toy", "--plot", "no/such/folder/x.png"], "its folder does not exist"),
        (["scenarios", "toi"], "did you mean toy"),
        (["bench", "toy", "--out", "/proc/horizonet"], "cannot write to /proc/horizonet"),
        (["bench", "nothing.toml", "--out", "r"], "nothing.toml: expected a plan in TOML"),
        (["bench", "quick", "--method", "mean", "--out", "r"], "states its own"),
        (["bench", "mhe-solver", "--out", "r"], "did you mean mhe-solvers"),
        (["bench", "quick", "toy", "--out", "r"], "a plan is run alone: quick with toy"),
        (["bench", "toy", "other", "--set", "fnce=1", "--out", "r"], "did you mean fence"),
        (["bench", "toy", "--solver", "swfit", "--out", "r"], "did you mean swift"),
        (["report", "/nonexistent"], "a folder written by horizonet bench"),
        (["halo"], "halo"),
    ],
)
def test_what_cannot_be_done_ends_with_code_2_and_says_why(words: list[str], told: str) -> None:
    result = horizonet(*words)
    assert result.exit_code == 2
    assert told in " ".join(result.stderr.replace("│", " ").split())
    assert result.stdout == ""


@pytest.mark.serial
def test_failed_trials_end_with_code_1_and_keep_the_others() -> None:
    found = answer("run", "toy", "--set", "mode=raise", "--json", code=1)
    by_method = {row["method"]: row for row in found["rows"]}
    assert by_method["first"]["metrics"] == {"error": None, "never": None}
    assert by_method["first"]["status"]["failed"] == 1
    assert by_method["mean"]["metrics"]["error"] > 0
    shown = horizonet("run", "toy", "--set", "mode=raise")
    assert shown.exit_code == 1
    assert "failed: ArithmeticError: the estimate diverged" in shown.stderr
    assert "horizonet run toy --method first --solver auto --set mode=raise --trials 1 --seed 0" in shown.stderr


@pytest.mark.serial
def test_a_pairing_that_does_not_exist_is_told_and_is_no_failure() -> None:
    shown = horizonet("run", "toy", "--solver", "slow", "--set", "mode=unfit")
    assert shown.exit_code == 0  # kalman needs no solver
    assert shown.stderr.count("not possible: FormError: solver 'slow' takes factor graphs only") == 2
    assert "failed" not in shown.stderr
    alone = horizonet("run", "toy", "--method", "mean", "--solver", "slow", "--set", "mode=unfit")
    assert alone.exit_code == 1  # nothing is left


@pytest.mark.serial
def test_a_bench_goes_on_when_an_estimator_raises(tmp_path: Path) -> None:
    out = str(tmp_path / "r")
    found = answer("bench", "toy", "--set", "mode=raise,calm", "--trials", "2", "--out", out, "--json", code=1)
    by = {(row["method"], row["settings"]["mode"]): row for row in found["rows"]}
    assert by["first", "raise"]["status"]["failed"] == 2
    assert by["first", "calm"]["metrics"]["error"] > 0
    html = tmp_path / "report.html"
    assert horizonet("report", out, "--html", str(html)).exit_code == 0
    text = html.read_text(encoding="utf-8")
    assert "the estimate diverged" in text
    assert "Traceback (most recent call last)" in text


@pytest.mark.serial
def test_an_input_that_cannot_be_read_ends_with_code_2() -> None:
    result = horizonet("run", "toy", "--set", "mode=unreadable")
    assert result.exit_code == 2
    assert "some/file.csv:3: expected a number; found 'x'" in result.stderr


@pytest.mark.serial
def test_standard_output_is_one_json_object_whatever_estimators_print(toy_package: Path) -> None:
    command = [sys.executable, "-m", "problems.cli", "run", "toy", "--set", "mode=print", "--json"]
    done = subprocess.run(command, env=environment(toy_package), capture_output=True, text=True, check=True)
    assert len(json.loads(done.stdout)["rows"]) == 3
    assert "chatter" in done.stderr
    assert "chatter from C" in done.stderr


@pytest.mark.serial
def test_run_draws_the_first_trial(tmp_path: Path) -> None:
    result = horizonet("run", "toy", "--trials", "2", "--plot", str(tmp_path / "toy.png"))
    assert result.exit_code == 0, result.stderr
    assert (tmp_path / "toy.png").read_bytes().startswith(b"\x89PNG")
    wrong = horizonet("run", "toy", "--plot", str(tmp_path / "toy.nonsense"))
    assert wrong.exit_code == 2
    assert "cannot write to" in wrong.stderr


@pytest.mark.serial
def test_bench_resumes_and_report_shows_the_same(tmp_path: Path) -> None:
    out = str(tmp_path / "r")
    words = [
        "bench",
        "toy",
        "other",
        "--solver",
        "swift",
        "--set",
        "tolerance=1e-3,1e-6",
        "--set",
        "fence=1",
        "--out",
        out,
    ]
    first = answer(*words, "--trials", "2", "--json")
    assert first["scenario"] == ["toy", "other"]
    assert len(first["rows"]) == 8
    again = horizonet(*words, "--trials", "3", "--json")
    assert f"16 of 24 rows are in {out} already" in again.stderr
    reported = answer("report", out, "--json")
    assert reported["rows"] == json.loads(again.stdout)["rows"]
    files = [tmp_path / name for name in ("a.html", "a.md", "a.csv")]
    done = horizonet("report", out, "--html", str(files[0]), "--markdown", str(files[1]), "--csv", str(files[2]))
    assert done.exit_code == 0
    assert "toy, 3 trials, seed 0" in done.stdout
    assert [path.read_text(encoding="utf-8")[:8] for path in files] == ["<!doctyp", "## toy\n\n", "scenario"]


@pytest.mark.serial
def test_a_plan_file_states_what_is_run(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('trials = 2\nseed = 9\n[[study]]\nscenario = "toy"\nmethods = ["mean"]\nsettings.steps = [2, 3]\n')
    found = answer("bench", str(plan), "--out", str(tmp_path / "r"), "--json")
    assert (found["seed"], found["trials"]) == (9, 2)
    assert [row["settings"]["steps"] for row in found["rows"]] == [2, 3]
    more = answer("bench", str(plan), "--trials", "1", "--seed", "4", "--out", str(tmp_path / "r"), "--json")
    assert (more["seed"], more["trials"]) == (4, 1)
    plan.write_text('trials = 2\n[[study]]\nscenario = "toy"\nmethds = ["mean"]\n')
    wrong = horizonet("bench", str(plan), "--out", str(tmp_path / "r"))
    assert wrong.exit_code == 2
    assert "plan.toml:4: expected a key of [[study]] (did you mean methods" in wrong.stderr


@pytest.mark.serial
def test_demo_runs_its_plan_afresh_and_writes_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'trials = 1\n[[study]]\nscenario = "toy"\nmethods = ["mean"]\n'
    monkeypatch.setattr("problems.cli.demo.built_in_plan", lambda name: plan_module.parse_plan(text, name))
    out = tmp_path / "demo"
    for _ in range(2):
        result = horizonet("demo", "--out", str(out))
        assert result.exit_code == 0, result.stderr
        assert "toy, 1 trial, seed 0" in result.stdout
        assert "already" not in result.stderr
    assert (out / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.serial
def test_an_interrupt_keeps_the_rows_and_says_how_to_go_on(tmp_path: Path, toy_package: Path) -> None:
    out = tmp_path / "r"
    command = [
        sys.executable,
        "-m",
        "problems.cli",
        "bench",
        "toy",
        "--method",
        "mean",
        "--trials",
        "20000",
        "--out",
        str(out),
    ]
    campaign = subprocess.Popen(
        command,
        env=environment(toy_package),
        stderr=subprocess.PIPE,
        text=True,
        # a test run in the background of a shell ignores interrupts, and its children would inherit that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while (
        not (out.exists() and (out / "journal.jsonl").stat().st_size > 20_000)
        and campaign.poll() is None
        and time.monotonic() < deadline
    ):
        time.sleep(0.01)
    campaign.send_signal(signal.SIGINT)
    _, errors = campaign.communicate(timeout=30)
    assert campaign.returncode not in (0, 2)
    assert "the same command goes on where it was" in errors
    assert "Traceback" not in errors
    assert answer("report", str(out), "--json")["rows"][0]["metrics"]["error"] > 0


def test_commands_of_other_packages_are_found_and_a_broken_one_breaks_nothing_else() -> None:
    assert horizonet("hello", "--times", "2").stdout == "hello hello \n"
    shown = horizonet("--help")
    assert shown.exit_code == 0
    for told in ("Say hello.", "Cannot be loaded", "report"):
        assert told in shown.stdout
    broken = horizonet("broken")
    assert broken.exit_code == 2
    assert "toy_scenarios_that_do_not_exist" in broken.stderr


def test_the_version_is_that_of_the_distribution() -> None:
    from importlib.metadata import version

    assert horizonet("--version").stdout.strip() == version("horizonet")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom problems.cli.main import app\n"
        "try:\n    app(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'gtsam', 'pandas', 'matplotlib', 'qpsolvers', 'osqp', 'pyarrow', 'networkx', 'plotly'}\n"
        "print('HEAVY', sorted(heavy & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "HEAVY []" in done.stdout


def environment(toy_package: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(toy_package), os.environ.get("PYTHONPATH", "")])}
