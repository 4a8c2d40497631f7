"""Errors that are logged once, however often they occur."""

from rclpy.node import Node


class LogOnce:
    """Logs the first error of each subject, so that a faulty sender cannot fill the disk."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._logged: dict[str, str] = {}

    def error(self, subject: str, text: str, *, repeat_if_changed: bool = False) -> None:
        """Log an error unless one was logged for the subject already.

        Parameters
        ----------
        repeat_if_changed
            Whether to log an error again if its text differs from the last one logged for the
            subject.
        """
        last = self._logged.get(subject)
        if last is None or repeat_if_changed and text != last:
            self._logged[subject] = text
            self._node.get_logger().error(text)

    def clear(self, subject: str) -> None:
        """Allow the next error of a subject to be logged again."""
        self._logged.pop(subject, None)
