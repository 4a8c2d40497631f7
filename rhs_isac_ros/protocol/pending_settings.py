"""Settings in use, and new settings that are not in use yet."""

from typing import Generic, TypeVar

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.settings import changes, describe_settings, shown

SettingsT = TypeVar('SettingsT')


class PendingSettings(Generic[SettingsT]):
    """Holds new settings back until the role may apply them.

    Attributes
    ----------
    in_use
        The settings in use.
    latest
        The settings received last.
    """

    def __init__(self, settings: SettingsT) -> None:
        self.in_use = settings
        self.latest = settings

    def apply(self) -> list[LogMessage]:
        """Put the latest settings into use; return a message that lists changes, if any."""
        changed = changes(self.in_use, self.latest)
        self.in_use = self.latest
        described = ', '.join(f'{name} {shown(value)!r}' for name, value in changed.items())
        return [LogMessage(f'settings applied: {described}')] if described else []

    def describe(self) -> dict[str, str]:
        """Return the values in use and the pending ones, as `settings.describe_settings` does."""
        return describe_settings(self.in_use, self.latest)
