"""The common parts of crash trials and intrusion trials: service before, recovery after."""

import dataclasses
import time
from collections.abc import Callable

from rhs_isac_ros.ros.processes import Processes
from system.observer import RECOVERY_LIMIT_S, NetworkObserver

# Maximum time to reach a state, also while a busy machine starts the nodes [s].
TIMEOUT_S = 120.0
# Number of latest cycles among which a served cycle is sought.
_N_LATEST = 20


class ChaosError(RuntimeError):
    """The network does not reach the state in which a trial can begin."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial:
    """Result of one trial."""

    #: Time from the end of the fault to the end of the first cycle served after it [s]; if the
    #: fault concerns a user, the first cycle of this user. None if there was none.
    recovery_s: float | None
    has_others: bool = True  #: Whether there are other nodes, which can report the fault.
    others_running: bool  #: Whether all other processes kept running.
    logged: tuple[str, ...]  #: Warnings that name the fault, each as ``<node>: <text>``.
    diagnosed: tuple[str, ...]  #: Nodes whose diagnostics reported the fault.
    violations: tuple[str, ...]  #: Results that violate an invariant.

    @property
    def recovered(self) -> bool:
        """Whether cycles were served in time and all other processes kept running."""
        return (self.recovery_s is not None and self.recovery_s <= RECOVERY_LIMIT_S
                and self.others_running)

    @property
    def reported(self) -> bool:
        """Whether logs and diagnostics of others reported the fault, without repeated warnings."""
        return bool(self.logged and self.diagnosed or not self.has_others
                    ) and len(set(self.logged)) == len(self.logged)


def both_served(observer: NetworkObserver, first: int) -> bool:
    """Return whether users 1 and 2 were served in the cycles since the index `first`."""
    return {1, 2} <= {
        record.user for record in observer.log.ended[first:] if record.outcome == 'served'}


def wait_for_service(observer: NetworkObserver) -> None:
    """Wait until both users have been served from now on; raise ChaosError after a timeout."""
    first = len(observer.log.ended)
    if not observer.spin_until(lambda: both_served(observer, first), TIMEOUT_S):
        outcomes = [record.outcome for record in observer.log.ended[first:]]
        raise ChaosError(f'the users were not served within {TIMEOUT_S:g} s; outcomes of the '
                         f'cycles: {outcomes or "none"}')


def measure_recovery(
        observer: NetworkObserver, end_s: float, user: int | None,
        also: Callable[[], bool] = lambda: True) -> float | None:
    """Return the time from the end of a fault until a cycle was served [s]; None if never.

    `end_s` is the end of the fault on the clock `time.monotonic` [s], `user` the user that must be
    served (None: any), and `also` a further condition for recovery.
    """
    def recovered() -> bool:
        return also() and any(
            record.outcome == 'served' and record.began_s > end_s and user in (None, record.user)
            for record in observer.log.ended[-_N_LATEST:])
    return time.monotonic() - end_s if observer.spin_until(recovered, TIMEOUT_S) else None


def warnings_since(
        processes: Processes, log_lengths: dict[str, int], excluded: str = '') -> list[str]:
    """Return new warnings in the logs of all processes but one, each with process and node.

    `log_lengths` contains the length of each old log, by name of the process.
    """
    return [f'{name}: {line.rpartition("[WARN] ")[2].split(" ", 1)[-1]}'
            for name, length in log_lengths.items() if name != excluded
            for line in processes.log(name)[length:].splitlines() if '[WARN]' in line]
