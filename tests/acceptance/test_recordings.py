"""Goal 1 of spec `recordings` 6 on the outdoor UWB recordings: through the command, with one fixed set of settings."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from problems.cli.main import app

CASES = ("los-trajectory_a-case_1", "nlos-trajectory_a-case_1")
LIMIT = dict(zip(CASES, (0.60, 0.65), strict=True))  # m
ESKF = dict(zip(CASES, (1.116, 0.938), strict=True))  # m, published


@pytest.fixture(scope="session")
def folders(data_dir: Path) -> dict[str, Path]:
    found = {case: data_dir / "uwb-outdoor" / case for case in CASES}
    for folder in found.values():
        if not folder.is_dir():
            pytest.skip(f"the recording {folder} is not there")
    return found


@cache
def localized(folder: Path, *words: str) -> dict:
    """The only row that `horizonet localize` prints for a recording."""
    result = CliRunner().invoke(app, ["localize", str(folder), "--json", *words])
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)["rows"]
    assert row["status"]["solved"] == sum(row["status"].values())
    return row


def rmse(folder: Path, *words: str) -> float:
    return localized(folder, *words)["metrics"]["rmse_2d"]


@pytest.mark.parametrize("case", CASES)
def test_causal_error_and_its_ratio_to_the_published_estimates(folders: dict[str, Path], case: str) -> None:
    row = localized(folders[case])
    assert (row["method"], row["settings"]["horizon"], row["options"]["delay"]) == ("mhe", 20, 0.0)
    metrics = row["metrics"]
    assert metrics["rmse_2d"] <= LIMIT[case]
    assert metrics["ratio_to_eskf"] == pytest.approx(metrics["rmse_2d"] / ESKF[case], rel=1e-3)
    assert metrics["ratio_to_eskf"] <= 0.80
    assert metrics["ratio_to_ls"] <= 0.80


def test_mean_ratios_to_the_published_filter(folders: dict[str, Path]) -> None:
    causal = [localized(folder)["metrics"]["ratio_to_eskf"] for folder in folders.values()]
    delayed = [
        localized(folder, "--method", "fixed_lag", "--set", "delay=1")["metrics"]["ratio_to_eskf"]
        for folder in folders.values()
    ]
    assert np.mean(causal) <= 0.60
    assert np.mean(delayed) <= 0.50


@pytest.mark.parametrize("case", CASES)
def test_biases_gain_a_quarter(folders: dict[str, Path], case: str) -> None:
    assert rmse(folders[case]) <= 0.75 * rmse(folders[case], "--set", "bias=off")


@pytest.mark.parametrize("case", CASES)
def test_plain_least_squares_fails(folders: dict[str, Path], case: str) -> None:
    assert rmse(folders[case], "--set", "loss=0") > 1.8


@pytest.mark.parametrize("case", CASES)
def test_a_window_of_two_with_one_iteration_does_as_well(folders: dict[str, Path], case: str) -> None:
    short = rmse(folders[case], "--set", "horizon=2", "--set", "iterations=1")
    assert short == pytest.approx(rmse(folders[case]), abs=0.03)


@pytest.mark.parametrize("case", CASES)
def test_coarse_fixes_help(folders: dict[str, Path], case: str) -> None:
    assert rmse(folders[case], "--set", "gps_rate=1", "--set", "gps_sigma=2") <= rmse(folders[case])
