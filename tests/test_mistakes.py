"""The page of mistakes: each block ends with the message under it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "mistakes.md").read_text(encoding="utf-8")
CASES = re.findall(r"## (\d+\. .*?)\n.*?```python\n(.*?)```\n\n```text\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize(("title", "block", "message"), CASES, ids=[case[0] for case in CASES])
def test_message(title: str, block: str, message: str) -> None:
    with pytest.raises(Exception) as caught:  # noqa: PT011  the text says which
        exec(compile(block, title, "exec"), {})
    assert f"{type(caught.value).__name__}: {caught.value}" == message.strip()


def test_there_are_ten() -> None:
    assert [int(title.split(".")[0]) for title, _, _ in CASES] == list(range(1, 11))
