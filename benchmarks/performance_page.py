"""The table of what the benchmarks recorded, printed and written to ``docs/performance.md``.

Run the benchmarks first: ``make bench`` does both.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import date
from importlib import metadata
from pathlib import Path

from record import FILE, Row, rows

PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"
PACKAGES = ("numpy", "scipy", "casadi", "daqp", "do-mpc", "cvxpy", "gtsam", "pypardiso", "quadprog")
HEAD = ("measure", "peer", "ours", "peer's", "ratio", "spread", "target", "met", "compile (ours / peer's)")


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions() -> str:
    """Python and the packages that take part."""
    out = [f"Python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            out.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            out.append(f"{name} not installed")
    return ", ".join(out)


def duration(seconds: float | None, unit: str = "s") -> str:
    """A number with its unit; times in the unit that suits them."""
    if seconds is None:
        return ""
    if unit != "s":
        return f"{seconds:.2f} {unit}".strip()
    for scale, name in ((1.0, "s"), (1e-3, "ms")):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {name}"
    return f"{seconds / 1e-6:.3g} us"


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table."""
    ratio, spread, target, met = "", "", "", ""
    if row.ratio is not None:
        ratio = f"{row.ratio:.3g}"
        spread = "" if row.low is None or row.high is None else f"{row.low:.3g} to {row.high:.3g}"
    elif row.peer:
        ratio = row.note or "not compared"
    if row.wanted is not None:
        target = f"at least {row.wanted:g}" if row.peer else f"at most {row.wanted:g} {row.unit}".strip()
        met = {True: "yes", False: "no", None: "not compared"}[row.reached]
    compiled = " / ".join(duration(one) or "-" for one in (row.compiled, row.compiled_theirs))
    return (
        row.measure,
        row.peer,
        duration(row.ours, row.unit),
        duration(row.theirs, row.unit),
        ratio,
        spread,
        target,
        met,
        "" if compiled == "- / -" else compiled,
    )


def table(lines: list[tuple[str, ...]]) -> str:
    """Markdown, columns aligned so that it can be read as it stands."""
    widths = [max(len(line[k]) for line in [HEAD, *lines]) for k in range(len(HEAD))]
    rule = tuple("-" * width for width in widths)
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |"
        for line in [HEAD, rule, *lines]
    )


def page(found: list[Row]) -> str:
    """The document."""
    missed = [f"- {row.measure}{f', {row.peer}' if row.peer else ''}" for row in found if row.reached is False]
    notes = [
        f"- {row.measure}{f', {row.peer}' if row.peer else ''}: {row.note}"
        for row in found
        if row.note and (row.ratio is not None or not row.peer)
    ]
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=PAGE.parent)
    parts = [
        "# Performance",
        "Written by `make bench`; do not edit. Both sides run in turns in one process with one thread, after a check "
        "that they found the same optimum (a benchmark fails where they did not). Ratios are the peer's median time "
        "over ours: above 1 ours is faster. The spread is that of the ratio over blocks of repetitions. What "
        "compilation costs, once per problem, is beside it where the time does not contain it.",
        f"Measured on {date.today()}: {processor()}, {os.cpu_count()} processors, {platform.system()}; {versions()}"
        + (f"; commit {commit.stdout.strip()}" if commit.returncode == 0 else "")
        + ". Other programs may have run beside.",
        table([cells(row) for row in found]),
    ]
    if missed:
        parts += ["## Targets that are missed", "\n".join(missed)]
    if notes:
        parts += ["## Notes", "\n".join(notes)]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    found = rows()
    if not found:
        sys.exit(f"no benchmark has recorded a row in {FILE}; run: make bench")
    PAGE.write_text(page(found))
    print(table([cells(row) for row in found]))
    print(f"\nwritten to {PAGE}")


if __name__ == "__main__":
    main()
