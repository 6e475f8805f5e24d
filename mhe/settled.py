"""Steps of a linear window once its arrival cost has settled: one product each (`problems.solvers.qp_recursion`)."""

from __future__ import annotations

import numpy as np

from mhe.arrival import ArrivalCost, WindowState
from mhe.window import Window
from problems.solvers.qp_recursion import Recursion
from problems.solvers.qp_session import QPSession


class SettledWindow:
    """Finds out whether a window's next steps are a `Recursion`, and keeps the one made last."""

    def __init__(self, window: Window, arrival: ArrivalCost) -> None:
        self._window, self._arrival = window, arrival
        self._made: Recursion | None = None

    def recursion(self, now: WindowState) -> Recursion | None:
        """The steps that come after `now`, ready to go on; None where they are none.

        Args:
            now: a full window, solved. A record is (y, u) of an instant; state and parameters are reported.
        """
        session = now.session
        # a session that assembles anew has no map to keep
        if type(session) is not QPSession or not np.isfinite(now.measurements).all():
            return None
        if not Recursion.suits(session) or not self._arrival.settled(now):
            return None
        if self._made is None or self._made.map is not session.current_map():
            layout, instants = session.layout, len(now.measurements)
            parts = {"y": now.measurements, "u": now.inputs}
            records = [
                layout.data_start[name] + np.arange(part.size).reshape(instants, -1)
                for name, part in parts.items()
                if part.size
            ]
            slots = [self._window.x[instants - 1]]
            if self._window.parameters is not None:
                slots.append(self._window.parameters[0])
            reported = np.concatenate([layout.columns(slot).ravel() for slot in slots])
            self._made = Recursion(session, np.hstack(records), reported, self._arrival.following(now))
        self._made.start()
        return self._made
