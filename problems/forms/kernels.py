"""Symbols of what least-squares solvers need of a cost term: value, gradient and Gauss-Newton Hessian per instance.

Whitening, robust weight and the products ``J'J`` are part of the generated code, so nothing is multiplied by structural
zeros and no small dense matrices are formed per instance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations_with_replacement

import casadi as ca

from problems.forms.template import Template
from problems.noise import Loss


@dataclass(frozen=True, eq=False)
class CostKernel:
    """Symbols of one cost template with its noise structure and loss.

    Attributes:
        inputs: SX column: stored coordinates, data, whitening numbers, linear part.
        stored: how many of them are coordinates.
        value: SX scalar, the cost of an instance.
        gradient: SX (width, 1) in tangent coordinates.
        hessian: SX column of the entries `pairs` of the Gauss-Newton Hessian.
        pairs: (a, b) with a <= b, positions in the tangent coordinates of the slots that are not structurally zero.
    """

    inputs: ca.SX
    stored: int
    value: ca.SX
    gradient: ca.SX
    hessian: ca.SX
    pairs: tuple[tuple[int, int], ...]

    @cached_property
    def value_function(self) -> ca.Function:
        """The cost alone."""
        return self._function(self.value)

    @cached_property
    def gradient_function(self) -> ca.Function:
        """Cost and gradient."""
        return self._function(self.value, self.gradient)

    @cached_property
    def function(self) -> ca.Function:
        """Cost, gradient and Hessian entries, one after the other."""
        return self._function(self.value, self.gradient, self.hessian)

    def _function(self, *outputs: ca.SX) -> ca.Function:
        return ca.Function("kernel", [self.inputs], [ca.cse(ca.densify(ca.vertcat(*outputs)))])


@lru_cache(maxsize=1024)
def cost_kernel(template: Template, full: bool, linear: bool, loss: Loss, switched: bool = False) -> CostKernel:
    """The kernel for diagonal or `full` (upper-triangular) whitening, with or without a linear part.

    With `switched`, a last input of 0 makes every output exactly zero, whatever the other inputs are (also NaN).
    """
    d, width = template.dim, template.width
    r, J = template.residual, ca.densify(template.jacobian)
    if full:
        entries = ca.SX.sym("U", d * (d + 1) // 2)
        U = ca.SX(d, d)
        for k, place in enumerate(combinations_with_replacement(range(d), 2)):
            U[place] = entries[k]
    else:
        entries = ca.SX.sym("U", d)
        U = ca.diag(entries)
    lam = ca.SX.sym("lin", d if linear else 0)
    on = ca.SX.sym("on", 1 if switched else 0)
    e, Je = ca.mtimes(U, r), ca.mtimes(U, template.jacobian)
    Je = ca.densify(Je)
    if switched:
        e = gate(on, e)
        Je = gate(on, Je)
    s = ca.sumsqr(e)
    rho, w = loss.rho(s), loss.weight(s)
    value, gradient = rho, w * ca.mtimes(Je.T, e)
    if linear:
        rows, slopes = (gate(on, r), gate(on, J)) if switched else (r, J)
        value = value + ca.dot(lam, rows)
        gradient = gradient + ca.mtimes(slopes.T, lam)
    H = ca.mtimes(ca.sparsify(Je).T, ca.sparsify(Je))
    pairs = tuple((a, b) for a in range(width) for b in range(a, width) if H.has_nz(a, b))
    hessian = ca.vertcat(*(w * H[a, b] for a, b in pairs)) if pairs else ca.SX(0, 1)
    inputs = ca.vertcat(template.point, template.numbers, entries, lam, on)
    return CostKernel(inputs, template.point.shape[0], value, ca.densify(gradient), hessian, pairs)


def gate(on: ca.SX, value: ca.SX) -> ca.SX:
    """`value` where on is not 0, else exactly 0."""
    flat = [ca.if_else(on, value.nz[k], 0) for k in range(value.nnz())]
    return ca.SX(value.sparsity(), ca.vertcat(*flat)) if flat else value
