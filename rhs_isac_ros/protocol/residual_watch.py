"""The residuals of all users and of each user, for the diagnostics of the positioner."""

import collections

from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.positioning.innovation_test import InnovationTest
from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.user_lists import MAX_NAMED
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS

# Number of residuals in the mean of a user, which bounds the memory.
_USER_WINDOW = 100


class ResidualWatch:
    """Compares residuals with the model, over all users and for each user.

    The signals of a single user with an unknown gain deviate with little effect on the mean over
    many users.
    """

    def __init__(self) -> None:
        self._codebook_id = ''
        self._all = InnovationTest()
        self._users: collections.OrderedDict[int, InnovationTest] = collections.OrderedDict()
        self._warning = ''

    def add(self, user: int, codebook_id: str, estimate: Estimate) -> list[LogMessage]:
        """Add the residual of an estimate; return a message if a warning begins or ends."""
        if codebook_id != self._codebook_id:
            self.clear()
            self._codebook_id = codebook_id
        own = self._users.setdefault(user, InnovationTest(_USER_WINDOW))
        self._users.move_to_end(user)
        # Beyond the limit, the least recent user is forgotten.
        if len(self._users) > MAX_USERS:
            self._users.popitem(last=False)
        for monitor in (self._all, own):
            monitor.add(float(estimate.residual), float(estimate.expected_residual))
        before, self._warning = self._warning, self._describe()
        if self._warning and not before:
            return [LogMessage(self._warning, warning=True)]
        if before and not self._warning:
            return [LogMessage('the residuals match the scenario again')]
        return []

    def clear(self) -> None:
        """Forget all residuals, because the estimator or the codebook has changed."""
        self._all.clear()
        self._users.clear()
        self._warning = ''

    def status(self) -> dict[str, str]:
        """Return the values for the diagnostics.

        Returns
        -------
        dict
            ``residual.ratio``, the mean energy of the residuals relative to the expectation;
            ``residual.spread``, the variance of the energy relative to the expectation;
            ``residual.fixes``, the number of fixes in the mean; and ``warning.residual`` during a
            warning. Empty before the first residual.
        """
        if not self._all.n_fixes:
            return {}
        values = {'residual.ratio': f'{self._all.ratio:.3f}',
                  'residual.spread': f'{self._all.spread:.3f}',
                  'residual.fixes': str(self._all.n_fixes)}
        return values | ({'warning.residual': self._warning} if self._warning else {})

    def _describe(self) -> str:
        """Describe the deviation; empty if there is none."""
        users = {user: monitor for user, monitor in self._users.items() if monitor.drifts}
        if not users and not self._all.drifts:
            return ''
        parts = [_deviation('', self._all)] if self._all.drifts else []
        parts += [_deviation(f'user {user}: ', users[user]) for user in sorted(users)[:MAX_NAMED]]
        if len(users) > MAX_NAMED:
            parts.append(f'{len(users) - MAX_NAMED} more users')
        return f'the signals do not match the scenario: {"; ".join(parts)}'


def _deviation(prefix: str, monitor: InnovationTest) -> str:
    return (f'{prefix}residuals {monitor.ratio:.3g} times as strong as expected, with '
            f'{monitor.spread:.3g} times the variance, over {monitor.n_fixes} cycles')
