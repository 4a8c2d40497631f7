"""Nodes that locate users: topics with the estimated poses and the odometry of users."""

from pathlib import Path
from typing import Any, TypeVar

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry

from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, PublishTrack
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.role_node import RoleNode

_RoleT = TypeVar('_RoleT', bound=Role)


class LocatingNode(RoleNode[_RoleT]):
    """A node that also publishes estimates as poses, and tracks as odometry.

    Poses are on a topic of all users and on one for each user.
    """

    def __init__(self, executable: str, **node_options: Any) -> None:
        super().__init__(executable, **node_options)
        self._all = endpoints.create_publisher(
            self, PoseWithCovarianceStamped, topics.POSITION, endpoints.EXCHANGE,
            overridable=True)
        limit = self.values.user_topics
        self._users = endpoints.UserTopics(
            self, {topics.POSE: PoseWithCovarianceStamped}, limit)
        # Only the users with tracks have these topics.
        self._tracks = endpoints.UserTopics(self, {topics.ODOMETRY: Odometry}, limit)

    @property
    def table_folder(self) -> Path | None:
        """Folder in which tables are cached; None without a home directory."""
        folder = self.values.table_folder
        return Path(folder) if folder else default_folder()

    def publish(self, message: m.Message) -> bool:
        """Publish a message, and an estimate also as a pose; return whether it was published."""
        is_published = super().publish(message)
        if is_published and isinstance(message, m.PositionEstimate):
            publishers = self._all, *self._users.publishers(message.user)
            endpoints.publish_if_subscribed(publishers, lambda: convert.pose(
                message, convert.stamp_of(message, self), self.frame))
        return is_published

    def execute(self, action: Action) -> None:
        """Publish the odometry of a track, or process another action."""
        if not isinstance(action, PublishTrack):
            super().execute(action)
        elif not self.stands_by:
            endpoints.publish_if_subscribed(
                self._tracks.publishers(action.user), lambda: convert.odometry(
                    action.user, action.estimate, convert.stamp_of(action, self), self.frame))
