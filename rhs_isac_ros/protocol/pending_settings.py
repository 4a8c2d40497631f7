"""Settings of a role: those in use, and those that wait for the end of the cycle."""

from typing import Any

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.settings import changes, describe_settings, shown


class PendingSettings:
    """Holds settings back until the role may change.

    Parameters
    ----------
    settings
        Those in use.

    Attributes
    ----------
    in_use
        The settings that the role works with.
    newest
        Those that it was given last.
    """

    def __init__(self, settings: Any) -> None:
        self.in_use = self.newest = settings

    def settle(self) -> list[LogMessage]:
        """Use the newest settings from now on.

        Returns
        -------
        list of Note
            What is another now, if anything.
        """
        changed = changes(self.in_use, self.newest)
        self.in_use = self.newest
        told = ', '.join(f'{name} {shown(value)!r}' for name, value in changed.items())
        return [LogMessage(f'from now on: {told}')] if told else []

    def describe(self) -> dict[str, str]:
        """Put them in words, for the diagnostics.

        Returns
        -------
        dict
            As of `settings.describe_settings`.
        """
        return describe_settings(self.in_use, self.newest)
