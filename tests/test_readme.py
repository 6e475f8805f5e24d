"""Every Python block of the README runs as it stands, and prints what the text says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.strip().splitlines()[0][:40])
def test_blocks_run(block: str) -> None:
    exec(compile(block, "README.md", "exec"), {})


def test_the_first_block_prints_what_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(BLOCKS[0], "README.md", "exec"), {})
    printed = capsys.readouterr().out.strip()
    said = re.search(r"It prints `(\w+ [\d.]+?)\.\.\.`", README)
    assert said is not None and printed.startswith(said.group(1))
