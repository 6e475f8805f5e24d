"""A nonlinear program in the order of its stages, as fatrop wants it.

The stages are found in the patterns of Jacobian and Hessian, as those of quadratic programs are. fatrop takes the
factor of a state in the row that defines it to be one, so such a factor must be a constant, by which the row is
divided.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from problems.forms.nonlinear import NonlinearProgram
from problems.forms.stages import Stages, find_stages

EXPANDED = 1000  # unknowns up to which one flat expression is worth its set-up: solves take a third of the time


class StagedProgram:
    """A program and its stages; made by `of`.

    Args:
        factors: (rows,) of the states in the rows that define them, else 1; in the order of the program.

    Attributes:
        casadi: what `casadi.nlpsol` takes instead of the program.
        options: the structure in the words of CasADi's interface.
    """

    def __init__(self, program: NonlinearProgram, stages: Stages, factors: np.ndarray) -> None:
        self._rows, self._factors = stages.rows, factors
        self._places = np.argsort(stages.unknowns)
        v = ca.MX.sym("v", program.variables.shape[0])
        p = ca.MX.sym("p", program.parameter.shape[0])
        whole = ca.Function("whole", [program.variables, program.parameter], [program.objective, program.constraints])
        f, g = whole(v[self._places.tolist()], p)  # type: ignore[misc]
        self.casadi = {"x": v, "p": p, "f": f, "g": (g / ca.DM(factors))[stages.rows.tolist()]}
        self.options: dict[str, Any] = {
            "structure_detection": "manual",
            "N": stages.states.size - 1,
            "nx": stages.states.tolist(),
            "nu": stages.controls.tolist(),
            "ng": stages.others.tolist(),
            "equality": (stages.rows < program.equalities).tolist(),
            "expand": v.shape[0] <= EXPANDED,
        }

    @classmethod
    def of(cls, program: NonlinearProgram) -> StagedProgram | None:
        """None where there is no chain of stages, or what defines a state has a factor that is no constant."""
        size, m = program.variables.shape[0], program.constraints.shape[0]
        jacobian, hessian = program.derivatives["jac_g"], program.derivatives["hess_lag"]
        J, H = jacobian.sparsity_out(1), hessian.sparsity_out(0)
        # of the blocks of a term many entries are zero, which is all that no multiplier weighs
        curved = _reads(hessian, 0, (2, 3))
        P, A = _pattern(H, np.flatnonzero(curved)), _pattern(J, np.arange(J.nnz()))
        stages = find_stages(P + P.T, A, np.arange(m) < program.equalities)
        if stages is None:
            return None
        rows, columns = (np.array(part, np.intp) for part in J.get_triplet())
        defining = np.flatnonzero(stages.defining[rows] == columns)
        if _reads(jacobian, 1, (0, 1))[defining].any():
            return None
        entries = jacobian(np.zeros(size), np.zeros(program.parameter.shape[0]))[1].nonzeros()  # type: ignore[index]
        factors = np.ones(m)
        factors[rows[defining]] = np.array(entries)[defining]
        return cls(program, stages, factors) if np.isfinite(factors).all() and factors.all() else None

    def ordered(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Arguments of a solve; it starts at v = 0 whatever the order is."""
        bounds = {name: (arguments[name] / self._factors)[self._rows] for name in ("lbg", "ubg")}
        return {**arguments, **bounds}

    def restored(self, results: dict[str, Any]) -> dict[str, Any]:
        """Point and multipliers in the order of the program."""
        y = np.empty(self._rows.size)
        y[self._rows] = np.array(results["lam_g"]).ravel()
        return {**results, "x": np.array(results["x"]).ravel()[self._places], "lam_g": y / self._factors}


def _reads(function: ca.Function, output: int, inputs: tuple[int, ...]) -> np.ndarray:
    """Which nonzero entries of an output depend on any of the inputs."""
    found = np.zeros(function.nnz_out(output), bool)
    for k in inputs:
        found[np.array(function.jac_sparsity(output, k, True).get_triplet()[0], np.intp)] = True
    return found


def _pattern(sparsity: ca.Sparsity, kept: np.ndarray) -> Any:
    rows, columns = (np.array(part, np.intp)[kept] for part in sparsity.get_triplet())
    return sp.csr_array((np.ones(rows.size), (rows, columns)), shape=sparsity.shape)
