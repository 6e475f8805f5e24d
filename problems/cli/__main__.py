"""``python -m problems.cli`` is the command `horizonet`."""

from problems.cli.main import run

if __name__ == "__main__":
    run()
