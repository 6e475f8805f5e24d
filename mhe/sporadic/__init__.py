"""Distributed moving horizon estimation with sporadic detections and fields of view."""

from mhe.sporadic.batched import BatchedDetections, DetectionBatch
from mhe.sporadic.design import SporadicDesign
from mhe.sporadic.estimate import DetectionEstimate
from mhe.sporadic.estimator import SporadicEstimator
from mhe.sporadic.node import SporadicNode
from mhe.sporadic.options import METHODS, SporadicOptions, options_of
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.pool import DetectionPool
from mhe.sporadic.readings import Reading

__all__ = [
    "METHODS",
    "BatchedDetections",
    "DetectionBatch",
    "DetectionEstimate",
    "DetectionPool",
    "Reading",
    "SporadicDesign",
    "SporadicEstimator",
    "SporadicNode",
    "SporadicOptions",
    "SporadicPlan",
    "options_of",
]
