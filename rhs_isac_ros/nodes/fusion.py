"""The executable ``fusion``: locates users from the posteriors of all surfaces of a site."""

import functools
import time
from typing import Any

import numpy as np

from rhs_isac_ros.positioning.site import SiteEstimator
from rhs_isac_ros.protocol.events import AgreementsDrawn
from rhs_isac_ros.protocol.fusion import Fusion
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.endpoints import BackgroundWorker
from rhs_isac_ros.ros.poses import LocatingNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import streams

# Number of simulated cycles with which the agreement of the surfaces is compared, and time between
# two of them [s], each of which takes some 20 ms.
_N_REFERENCES, _DRAW_PERIOD_S = 300, 0.05


class FusionNode(LocatingNode[Fusion]):
    """The fusion of a site, which draws the references of its test of poses after its start."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('fusion', **node_options)
        site = self.surface.site
        assert site
        worker = BackgroundWorker(self)
        self.endings.callback(worker.close)
        self._rng = streams.generator(self.values.seed, streams.AGREEMENTS)
        self._drawn: list[AgreementsDrawn] = []
        self.start(Fusion(site, time.perf_counter, self.make_settings(self.values)),
                   subscribe=False)
        if len(site.surfaces) > 1:
            folder = self.table_folder
            worker.run(lambda: SiteEstimator(site, folder), self._begin_drawing)
        else:
            self.subscribe()

    def _begin_drawing(self, estimator: SiteEstimator) -> None:
        # The first fusion takes longer than later ones; no user should have to wait for it.
        self._draw(estimator)
        self.subscribe()
        # In a thread, the draws would take the interpreter from the fusion for seconds.
        self._timer_of_draws = endpoints.steady_timer(
            self, _DRAW_PERIOD_S, functools.partial(self._draw, estimator))

    def _draw(self, estimator: SiteEstimator) -> None:
        if self.role.next_deadline() is not None:
            # The base station waits for a position.
            return
        self._drawn.append(AgreementsDrawn(*estimator.draw_agreements(1, self._rng)))
        if len(self._drawn) == _N_REFERENCES:
            self.destroy_timer(self._timer_of_draws)
            self.dispatch(AgreementsDrawn(
                [one for drawn in self._drawn for one in drawn.references],
                np.concatenate([drawn.places for drawn in self._drawn])))


main = entry('fusion', lambda: [FusionNode()])
