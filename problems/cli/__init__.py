"""The command `horizonet`, one file for each of its commands."""
