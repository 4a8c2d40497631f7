"""One run of the network on several hosts, in which links are taken down and restored."""

import time

from rhs_isac_ros.ros.processes import Processes
from system import invariants
from system.hosts import plan
from system.hosts.namespaces import Hosts
from system.hosts.verdict import Outage, evaluate
from system.observer import NetworkObserver

# Maximum time from the start of the network to its first cycle [s].
_START_TIMEOUT_S = 60.0
# Maximum duration of the observation before and after an outage [s].
_BEFORE_S = 5.0
_AFTER_S = 20.0


class NetworkBroken(RuntimeError):
    """A node has ended, or no cycle is served."""


class Trial:
    """A network on several hosts, observed while links are taken down."""

    def __init__(
            self, hosts: Hosts, processes: Processes, observer: NetworkObserver) -> None:
        self._hosts, self._processes, self._observer = hosts, processes, observer

    def wait_until_served(self) -> None:
        """Wait until cycles are served.

        Raises
        ------
        NetworkBroken
            If a node ends, or no cycle is served within a minute.
        """
        self._spin(_START_TIMEOUT_S, 3)
        if not self._observer.log.complete:
            raise NetworkBroken(f'no cycle within {_START_TIMEOUT_S:.0f} s; log of the base '
                                f'station:\n{self._processes.log("bs")}')

    def interrupt(self, host: str, seconds: float) -> Outage:
        """Take the link of a host down, restore it, and wait until cycles are served again.

        Parameters
        ----------
        host
            Name of the host.
        seconds
            Duration of the outage [s].

        Raises
        ------
        NetworkBroken
            If a node ends.
        """
        marks_s = [time.monotonic()]
        self._spin(min(seconds, _BEFORE_S))
        log_lengths = {node: len(self._processes.log(node)) for node in self._processes.names}
        self._observer.warnings.clear()
        self._hosts.disconnect(host)
        marks_s.append(time.monotonic())
        self._spin(seconds)
        logs = {node: self._processes.log(node)[n:] for node, n in log_lengths.items()}
        warnings = {node: tuple(texts) for node, texts in self._observer.warnings.items()}
        marks_s.append(time.monotonic())
        self._observer.invariants.expect_rediscovery(invariants.RECEIVES)
        self._hosts.reconnect(host)
        self._spin(_AFTER_S, 3)
        marks_s.append(time.monotonic())
        waiting = plan.waiting(host, seconds)
        return evaluate(
            host, marks_s, self._observer.log.complete, logs, warnings,
            [node for node in log_lengths if node.partition('_')[0] in waiting])

    def settle(self) -> None:
        """Wait until all results have been checked."""
        self._spin(invariants.CHECK_DELAY_S)

    def _spin(self, seconds: float, cycles: int = 0) -> None:
        """Observe for a time, or until a number of cycles (0: none) have begun and been served."""
        begin_s = time.monotonic()

        def done() -> bool:
            for node, code in self._processes.ended().items():
                raise NetworkBroken(
                    f'{node} ended with exit code {code}:\n{self._processes.log(node)}')
            if not cycles:
                return False
            newest = self._observer.log.complete[-cycles:]
            return len(newest) == cycles and newest[0].began_s >= begin_s
        self._observer.spin_until(done, seconds)
