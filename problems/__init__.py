"""State an estimation problem once, in symbols; solve it as a QP, a nonlinear program or a factor graph."""

from problems.errors import HorizonetError
from problems.models import LinearModel, NonlinearModel, Sensor, simulate
from problems.noise import L2, Cauchy, Gaussian, GemanMcClure, Huber, Tukey
from problems.problem import Problem
from problems.soft import Soft
from problems.spaces import SE2, SO2, Pose2, Rotation2, Vector, wrap
from problems.spatial import SE3, SO3, Pose3, Rotation3

__all__ = [
    "L2",
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "Cauchy",
    "Gaussian",
    "GemanMcClure",
    "HorizonetError",
    "Huber",
    "LinearModel",
    "NonlinearModel",
    "Pose2",
    "Pose3",
    "Problem",
    "Rotation2",
    "Rotation3",
    "Sensor",
    "Soft",
    "Tukey",
    "Vector",
    "simulate",
    "wrap",
]
