"""What models refuse."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from example_models import X1, X3, ring, unicycle

from problems.errors import (
    DataError,
    DefinitionError,
    NoiseError,
    SettingError,
    ShapeError,
)
from problems.models import (
    LinearModel,
    NonlinearModel,
    Sensor,
)


class TestRefusals:
    @pytest.mark.parametrize(
        ("error", "message", "build"),
        [
            (ShapeError, "A", lambda: LinearModel(np.ones((2, 3)), np.eye(2))),
            (ShapeError, "A", lambda: LinearModel(np.ones(4), np.eye(2))),
            (DefinitionError, "A.*finite", lambda: LinearModel([[np.nan]], np.eye(1))),
            (DefinitionError, "A.*array of numbers", lambda: LinearModel("abc", np.eye(1))),
            (ShapeError, "B", lambda: LinearModel(np.eye(2), np.eye(2), B=np.ones((3, 1)))),
            (ShapeError, "G", lambda: LinearModel(np.eye(2), np.eye(1), G=np.ones((3, 1)))),
            (ShapeError, "Q", lambda: LinearModel(np.eye(2), np.eye(3))),
            (ShapeError, "Q.*numpy.diag", lambda: LinearModel(np.eye(2), [1.0, 1.0])),
            (NoiseError, "Q.*finite", lambda: LinearModel(np.eye(2), np.diag([1, np.nan]))),
            (NoiseError, "Q.*symmetric", lambda: LinearModel(np.eye(2), [[1, 0.1], [0, 1]])),
            (NoiseError, "Q.*positive definite", lambda: LinearModel(np.eye(2), np.diag([1.0, -1.0]))),
            (NoiseError, "Q.*positive definite", lambda: LinearModel(np.eye(2), [[1, 2], [2, 1]])),
            # target-tracking-dkns (3.23): rank two, but for rounding
            (NoiseError, "gain G", lambda: LinearModel(np.eye(2), [[0.07**2 / 4, 0.035], [0.035, 1.0]])),
            (NoiseError, "Pi_0", lambda: LinearModel(np.eye(2), np.eye(2), covariance=np.zeros((2, 2)))),
            (ShapeError, "mu_0", lambda: LinearModel(np.eye(2), np.eye(2), mean=[0, 0, 0])),
            (DefinitionError, "state_names", lambda: ring(state_names=["a", "b", "c", "a"])),
            (DefinitionError, "dt", lambda: ring(dt=-1.0)),
            (DefinitionError, "dt", lambda: LinearModel.continuous(np.eye(1), None, 1.0, 0.0)),
            (NoiseError, "Qc", lambda: LinearModel.continuous(np.eye(2), None, np.zeros((2, 2)), 1.0)),
            (ShapeError, "'s'.*C", lambda: LinearModel(np.eye(2), np.eye(2), sensors=[Sensor("s", [X1], sigma=1)])),
            (
                DefinitionError,
                "NonlinearModel",
                lambda: LinearModel(np.eye(2), np.eye(2), sensors=[Sensor("s", lambda x: x, sigma=1)]),
            ),
            (DefinitionError, "differ", lambda: ring().with_sensors([Sensor("s", [X1], sigma=1.0)] * 2)),
        ],
    )
    def test_linear(self, error, message, build):
        with pytest.raises(error, match=message):
            build()

    @pytest.mark.parametrize(
        ("error", "message", "build"),
        [
            (NoiseError, "exactly one", lambda: Sensor("s", [X1])),
            (NoiseError, "exactly one", lambda: Sensor("s", [X1], sigma=1.0, covariance=[[1.0]])),
            (NoiseError, "R.*definite", lambda: Sensor("s", [X1, X3], covariance=[[1, 1], [1, 1]])),
            (NoiseError, "sigma.*positive", lambda: Sensor("s", [X1], sigma=0.0)),
            (NoiseError, "sigma.*positive", lambda: Sensor("s", [X1], sigma=np.nan)),
            (ShapeError, "sigma", lambda: Sensor("s", [X1], sigma=[1.0, 2.0])),
            (ShapeError, "R", lambda: Sensor("s", [X1, X3], covariance=np.eye(3))),
            (ShapeError, "C", lambda: Sensor("s", X1, sigma=1.0)),
            (DefinitionError, "C.*finite", lambda: Sensor("s", [[np.inf]], sigma=1.0)),
            (DefinitionError, "angles", lambda: Sensor("s", [X1], sigma=1.0, angles=[1])),
            (SettingError, "period", lambda: Sensor("s", [X1], sigma=1.0, period=0)),
        ],
    )
    def test_sensor(self, error, message, build):
        with pytest.raises(error, match=message):
            build()

    @pytest.mark.parametrize(
        ("error", "message", "build"),
        [
            (ShapeError, "dynamics.*2 components", lambda: NonlinearModel(lambda x: x[0], np.eye(2), 2)),
            (ShapeError, "column", lambda: NonlinearModel(lambda x: x.T, np.eye(2), 2)),
            (DefinitionError, "takes 2 argument", lambda: NonlinearModel(lambda x, u: x, np.eye(2), 2)),
            (DefinitionError, "takes 0 argument", lambda: NonlinearModel(lambda: 1, np.eye(1), 1)),
            (DefinitionError, "failed on CasADi", lambda: NonlinearModel(lambda x: 1 / 0, np.eye(1), 1)),
            (DefinitionError, "got object", lambda: NonlinearModel(lambda x: object(), np.eye(1), 1)),
            (DefinitionError, "function or", lambda: NonlinearModel("x", np.eye(1), 1)),
            (DefinitionError, "stray", lambda: NonlinearModel(lambda x: x + ca.SX.sym("stray"), np.eye(1), 1)),
            (DefinitionError, "mixes", lambda: NonlinearModel(ca.MX.sym("m"), np.eye(1), 1)),
            (DefinitionError, "states", lambda: NonlinearModel(lambda x: x, np.eye(1), 0)),
            (DefinitionError, "inputs", lambda: NonlinearModel(lambda x: x, np.eye(1), 1, inputs=-1)),
            (DefinitionError, "states", lambda: NonlinearModel(lambda x: x, np.eye(1), ca.SX.sym("x") ** 2)),
            (
                DefinitionError,
                "all be",
                lambda: NonlinearModel(lambda x: x, np.eye(1), ca.SX.sym("x"), inputs=ca.MX.sym("u")),
            ),
            (DefinitionError, "dt", lambda: unicycle(dt=None)),
            (SettingError, "method", lambda: unicycle(method="rk5")),
            (SettingError, "substeps", lambda: unicycle(substeps=0)),
            (DefinitionError, "'s'.*failed", lambda: unicycle(sensors=[Sensor("s", lambda x: x[7], sigma=1.0)])),
            (ShapeError, "sigma", lambda: unicycle(sensors=[Sensor("s", lambda x: x[:2], sigma=[1, 2, 3])])),
        ],
    )
    def test_nonlinear(self, error, message, build):
        with pytest.raises(error, match=message):
            build()

    def test_calls(self):
        model = unicycle()
        with pytest.raises(DataError, match="input"):
            model.step(np.zeros(3))
        with pytest.raises(ShapeError, match="state"):
            model.step(np.zeros(4), np.zeros(2))
        with pytest.raises(ShapeError, match="state"):
            model.step(ca.SX.sym("x", 4), np.zeros(2))
        with pytest.raises(ShapeError, match="parameters"):
            model.step(np.zeros(3), np.zeros(2), np.zeros(1))
