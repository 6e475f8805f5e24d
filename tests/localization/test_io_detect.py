"""Readers found through the registry, and readers under random damage to good files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from localization.io import PoseGraph, TeamRecording, UwbRecording, open_recording
from localization.io.samples import write_samples
from problems import registry
from problems.errors import ReadError, SettingError

Find = Callable[[str], Path]
READERS = {"uwb_outdoor", "uwb_labyrinth", "mrclam", "g2o", "pyfg"}


def test_readers_are_registered() -> None:
    assert READERS <= set(registry.names("readers"))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("uwb-outdoor/los-trajectory_a-case_1", UwbRecording),
        ("uwb-labyrinth", UwbRecording),
        ("mrclam7", TeamRecording),
        ("pyfg/small.pyfg", PoseGraph),
        ("g2o/tinyGrid3D.g2o", PoseGraph),
    ],
)
def test_real_recordings_are_recognized(real_data: Find, name: str, kind: type) -> None:
    path = real_data(name)
    recording = open_recording(path)
    assert isinstance(recording, kind) and recording.name == path.stem


def test_samples_are_recognized_by_exactly_one_reader(samples: dict[str, Path]) -> None:
    readers = [registry.load("readers", name) for name in registry.names("readers")]
    for kind, path in samples.items():
        assert sum(reader.matches(path) for reader in readers) == 1
        open_recording(str(path))
        name = kind.removesuffix("_3d")
        assert registry.load("readers", name).layout.startswith(name + ":")


def test_samples_are_the_same_bytes_for_the_same_seed(samples: dict[str, Path], tmp_path: Path) -> None:
    again = write_samples(tmp_path, np.random.default_rng(7))
    for kind, path in samples.items():
        pairs = [(path, again[kind])] if path.is_file() else [(f, again[kind] / f.name) for f in path.iterdir()]
        assert pairs and all(a.read_bytes() == b.read_bytes() for a, b in pairs)


def test_unknown_layouts_name_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="nothing there"):
        open_recording(tmp_path / "absent")
    (tmp_path / "notes.txt").write_text("hello")
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(ReadError) as caught:
            open_recording(path)
        assert all(f"{name}: " in str(caught.value) for name in READERS)


def test_settings_go_to_the_reader(samples: dict[str, Path]) -> None:
    assert open_recording(samples["uwb_outdoor"], trajectory="B").trajectory == "B"
    with pytest.raises(SettingError, match="no setting 'trajectori'; valid: trajectory"):
        open_recording(samples["uwb_outdoor"], trajectori="B")
    with pytest.raises(SettingError, match="valid: none"):
        open_recording(samples["g2o"], trajectory="B")


TOKENS = st.sampled_from(
    [
        "",
        "nan",
        "-1",
        "0",
        "1e999",
        "1_0",
        "x",
        "99999999999999999999999",
        "-",
        "1e-320",
        "#",
        ",",
        "A1",
        "L0",
        "1.7e18",
        "\x00",
        "é",
    ]
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Samples cut short, so that hundreds of damaged copies are read in seconds; and a labyrinth folder."""
    paths = write_samples(tmp_path_factory.mktemp("small"), np.random.default_rng(11))
    for folder in (paths["uwb_outdoor"], paths["mrclam"]):
        for file in folder.iterdir():
            file.write_text("".join(file.read_text().splitlines(keepends=True)[:30]))
    labyrinth = paths["g2o"].parent / "labyrinth"
    labyrinth.mkdir()
    lines = [f"range2 {0.1 * k} {1 + 0.1 * k} 0.01 {k % 2} 0 {k % 2} 0" for k in range(8)]
    lines += [f"odom2diff {0.1 * k} 0.1 0.2 0 0.0785 1e-4 1e-4 1e-4" for k in range(8)]
    (labyrinth / "A_Input.txt").write_text("\n".join(lines))
    (labyrinth / "A_GT.txt").write_text("\n".join(f"point2 {0.1 * k} {k} 1 0 0 0 0" for k in range(8)))
    return paths | {"uwb_labyrinth": labyrinth}


@pytest.mark.parametrize("kind", ["uwb_outdoor", "uwb_labyrinth", "mrclam", "pyfg", "pyfg_3d", "g2o", "g2o_3d"])
@settings(
    derandomize=True,
    max_examples=80,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.data())
def test_damaged_files_are_refused_or_read(
    small: dict[str, Path], tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    source = small[kind]
    copy = tmp_path / source.name
    if source.is_dir():
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(source, copy)
        victim = data.draw(st.sampled_from(sorted(copy.iterdir())))
    else:
        shutil.copy(source, copy)
        victim = copy
    content = victim.read_bytes()
    if data.draw(st.booleans()):
        victim.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    else:
        lines = content.decode().split("\n")
        row = data.draw(st.integers(0, len(lines) - 1))
        mark = "," if victim.suffix == ".csv" else " "
        tokens = lines[row].split(mark)
        tokens[data.draw(st.integers(0, len(tokens) - 1))] = data.draw(TOKENS)
        lines[row] = mark.join(tokens)
        victim.write_bytes("\n".join(lines).encode())
    reader = registry.load("readers", kind.removesuffix("_3d"))
    try:
        recording = reader.read(copy)
    except ReadError as error:
        assert error.expected and error.path.name in (victim.name, copy.name)
        return
    for name in ("time", "ranges", "range_bearing", "sighting_time"):
        values = getattr(recording, name, None)
        if isinstance(values, np.ndarray) and kind[:3] != "g2o":
            assert np.isfinite(values).all()
    if isinstance(recording, PoseGraph):
        for edges in (recording.relative_poses, recording.sightings, recording.ranges):
            assert np.isfinite(edges.value).all()
            np.linalg.cholesky(edges.information)
