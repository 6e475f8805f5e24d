"""Example models: a ring of oscillators and a unicycle."""

from __future__ import annotations

import casadi as ca
import numpy as np

from problems.models import (
    LinearModel,
    NonlinearModel,
    Sensor,
)

# the four-state example of dmhe-pre-estimation 6.1
RING_A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])


RING_Q = np.diag([0.0012, 0.038, 0.0012, 0.038])


X1, X3, NOTHING = [1.0, 0, 0, 0], [0.0, 0, 1, 0], [0.0, 0, 0, 0]


BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def ring(**settings):
    sensors = [Sensor("first", [X1], sigma=1.0), Sensor("third", [X3], sigma=1.0)]
    return LinearModel(RING_A, RING_Q, sensors=sensors, covariance=np.eye(4), **settings)


def unicycle_rate(x, u):
    return [u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]]


def unicycle(**settings):
    ranges = [Sensor(f"range{k}", lambda x, c=c: ca.norm_2(x[:2] - c), sigma=0.1) for k, c in enumerate(BEACONS)]
    compass = Sensor("compass", lambda x: x[2], sigma=0.05, angles=[0], period=5)
    given = {
        "sensors": [*ranges, compass],
        "mean": [2.0, 1.0, 0.2],
        "covariance": np.diag([0.04, 0.04, 0.01]),
        "dt": 0.1,
        "continuous": True,
    } | settings
    return NonlinearModel(unicycle_rate, np.diag([1e-4, 1e-4, 1e-5]), 3, inputs=2, **given)
