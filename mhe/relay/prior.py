"""The prior of instant 0 as an information matrix, stated so that covariance and information cannot be mixed up.

Source: dmhe-l-step, Assumptions (weight/covariance convention), What working means 19.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mhe.covariance import definite, symmetrized
from problems.errors import DefinitionError
from problems.models import LinearModel

IMPLAUSIBLE = 1e-2  # a prior that knows a measured quantity so much better than its sensor does is a mistaken matrix


def prior_information(model: LinearModel, cov: Any = None, info: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and information matrix P_0 (n, n) of x_0.

    Args:
        model: its `mean` is taken (zero if it has none), and its `covariance` where neither of the two is given.
        cov: covariance (n, n) of x_0.
        info: its inverse, P_0 of the source.

    Raises:
        DefinitionError: no prior or two that differ, or a matrix of which the other reading makes sense.
        NoiseError, ShapeError: a matrix that is not symmetric positive definite, or of the wrong size.
    """
    n = model.state_size
    mean = np.zeros(n) if model.mean is None else model.mean
    if cov is not None and info is not None:
        raise DefinitionError("give the prior once: cov= (covariance) or info= (its inverse, an information matrix)")
    if cov is None and info is None:
        if model.covariance is None:
            raise DefinitionError(
                "the prior of x_0 is missing: give cov= (covariance, in squared units of the state) or info= (its "
                "inverse, P_0 of the source), or state it in the model"
            )
        return mean, symmetrized(np.linalg.inv(model.covariance))
    name, other, value = ("cov", "info", cov) if info is None else ("info", "cov", info)
    matrix = definite(f"{name}=", np.asarray(value, dtype=float))
    if matrix.shape != (n, n):
        raise DefinitionError(f"{name}=: expected shape {(n, n)}, got {matrix.shape}")
    inverse = symmetrized(np.linalg.inv(matrix))
    covariance, information = (matrix, inverse) if name == "cov" else (inverse, matrix)
    if model.covariance is not None:
        if not np.allclose(covariance, model.covariance, rtol=1e-6, atol=0):
            raise DefinitionError(
                f"{name}= says prior standard deviations {_deviations(model, covariance)}, the model's covariance says "
                f"{_deviations(model, model.covariance)}; give one prior, or two that agree. cov= takes a covariance, "
                "info= its inverse"
            )
        return mean, information
    _require_plausible(model, name, other, covariance, information)
    return mean, information


def _require_plausible(
    model: LinearModel, name: str, other: str, covariance: np.ndarray, information: np.ndarray
) -> None:
    noise = np.diagonal(model.R)
    known = np.sqrt(np.einsum("pi,ij,pj->p", model.C, covariance, model.C) / noise)
    otherwise = np.sqrt(np.einsum("pi,ij,pj->p", model.C, information, model.C) / noise)
    measured = model.C.any(axis=1)
    if (measured & (known < IMPLAUSIBLE) & (otherwise > IMPLAUSIBLE)).any():
        raise DefinitionError(
            f"{name}= says prior standard deviations {_deviations(model, covariance)}: a measured quantity would be "
            f"known {1 / known[measured].min():.3g} times better than its sensor measures it. As {other}= the same "
            f"matrix says {_deviations(model, information)}. Pass it as {other}=, or, if it is meant so, state the "
            "prior in the model (covariance=) as well"
        )


def _deviations(model: LinearModel, covariance: np.ndarray) -> str:
    values = np.sqrt(np.diagonal(covariance)).tolist()
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(model.state_names, values, strict=True))
