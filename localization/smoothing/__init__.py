"""Fixed-lag smoothing of moving teams, and starting values for the recorded graphs of teams."""

from localization.smoothing.fixed_lag import FixedLagSmoother, TeamEstimate
from localization.smoothing.kinds import Fence, Kind, Lasting, Readings

__all__ = ["Fence", "FixedLagSmoother", "Kind", "Lasting", "Readings", "TeamEstimate"]
