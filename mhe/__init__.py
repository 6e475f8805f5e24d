"""Moving horizon estimation: windows stated once, centralized estimators, Kalman baselines under one protocol."""

from mhe.centralized import MovingHorizonEstimator, WindowEstimate, mhe, mhe_pre
from mhe.estimate import Estimate, Estimator
from mhe.filters import ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter
from mhe.polyhedron import Polyhedron
from mhe.window import Window

__all__ = [
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "KalmanFilter",
    "MovingHorizonEstimator",
    "Polyhedron",
    "UnscentedKalmanFilter",
    "Window",
    "WindowEstimate",
    "mhe",
    "mhe_pre",
]
