"""Recordings: readers and writers of their formats, scoring against their truth, generated samples."""

from localization.io.detect import Reader, open_recording
from localization.io.poses import Poses, read_poses, read_tum, write_poses, write_tum
from localization.io.recording import (
    Edges,
    PoseGraph,
    Priors,
    Recording,
    TeamRecording,
    TimeSeries,
    UwbRecording,
)

__all__ = [
    "Edges",
    "PoseGraph",
    "Poses",
    "Priors",
    "Reader",
    "Recording",
    "TeamRecording",
    "TimeSeries",
    "UwbRecording",
    "open_recording",
    "read_poses",
    "read_tum",
    "write_poses",
    "write_tum",
]
