"""Simulate two robots, and compare the poses that a network estimates with the true poses.

The script publishes the time on /clock, the odometry of each robot at 20 Hz and, if tf2_msgs is
installed, its transform on /tf. It prints the error of each estimated pose, and draws the true and
the estimated poses:

    python3 docs/examples/two_robots.py --poses 60 --picture robots.png
"""

import argparse
import math
import time

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

STEP_S, ODOMETRY_S, BEGIN_S = 0.01, 0.05, 1000.0
HEIGHT_M, RADIUS_M = 0.5, 2.0
# Centre x, y of each robot's circle in the map [m], and speed [m/s], negative if clockwise.
ROBOTS = {1: (-2.5, 0.0, 1.0), 2: (2.5, -1.0, -0.7)}


def drive(robot, now_s):
    """Return position x, y [m] and heading [rad] of a robot in the map at the time `now_s`."""
    x, y, speed = ROBOTS[robot]
    angle = speed / RADIUS_M * now_s
    return (x + RADIUS_M * math.cos(angle), y + RADIUS_M * math.sin(angle),
            angle + math.copysign(math.pi / 2, speed))


class Simulation(Node):
    """Publishes clock, odometry and transforms, and collects the poses of each robot."""

    def __init__(self, rate):
        super().__init__('simulation')
        self._rate, self._steady = rate, Clock(clock_type=ClockType.STEADY_TIME)
        self._begun_s, self._published_s = time.monotonic(), -math.inf
        self.poses = {robot: [] for robot in ROBOTS}
        self._clock = self.create_publisher(ClockMessage, '/clock', 10)
        self._odometry = {robot: self.create_publisher(Odometry, f'robot_{robot}/odom', 10)
                          for robot in ROBOTS}
        self._transforms = TFMessage and self.create_publisher(TFMessage, '/tf', 100)
        for robot in ROBOTS:
            self.create_subscription(
                PoseWithCovarianceStamped, f'users/user_{robot}/pose',
                lambda pose, robot=robot: self._compare(robot, pose), 10)
        self.create_timer(STEP_S / rate, self._step, clock=self._steady)

    def _step(self):
        now_s = BEGIN_S + self._rate * (time.monotonic() - self._begun_s)
        stamp = Time(nanoseconds=int(now_s * 1e9)).to_msg()
        self._clock.publish(ClockMessage(clock=stamp))
        if now_s < self._published_s + ODOMETRY_S:
            return
        self._published_s = now_s
        for robot, publisher in self._odometry.items():
            x, y, heading = drive(robot, now_s)
            message = Odometry(child_frame_id=f'robot_{robot}/base_link')
            message.header.stamp, message.header.frame_id = stamp, 'map'
            place, turn = message.pose.pose.position, message.pose.pose.orientation
            place.x, place.y, place.z = x, y, HEIGHT_M
            turn.z, turn.w = math.sin(heading / 2), math.cos(heading / 2)
            # In the frame of the robot, x points in the direction of travel.
            message.twist.twist.linear.x = abs(ROBOTS[robot][2])
            publisher.publish(message)
            if self._transforms:
                transform = TransformStamped(
                    header=message.header, child_frame_id=message.child_frame_id)
                moved = transform.transform.translation
                moved.x, moved.y, moved.z = x, y, HEIGHT_M
                transform.transform.rotation = turn
                self._transforms.publish(TFMessage(transforms=[transform]))

    def _compare(self, robot, pose):
        now_s = 1e-9 * Time.from_msg(pose.header.stamp).nanoseconds
        x, y, _ = drive(robot, now_s)
        place = pose.pose.pose.position
        error_m = math.dist((x, y, HEIGHT_M), (place.x, place.y, place.z))
        self.poses[robot].append((x, y, place.x, place.y))
        print(f'robot {robot} at {now_s - BEGIN_S:8.2f} s: {place.x:6.2f} {place.y:6.2f} m in '
              f'{pose.header.frame_id}, error {error_m:.2f} m', flush=True)


def draw(poses, path):
    """Draw the true and estimated positions of each robot, and the surface, from above."""
    from rhs_isac_ros.support.pictures import (
        COLUMN_IN,
        look,
        new_figure,
        paper_style,
        write_picture,
    )
    with paper_style():
        figure = new_figure(COLUMN_IN, COLUMN_IN)
        axes = figure.subplots()
        for index, (robot, rows) in enumerate(poses.items()):
            x, y, found_x, found_y = zip(*rows, strict=True)
            own = look(index)
            axes.plot(found_x, found_y, own.marker, color=own.colour, markersize=3,
                      label=f'poses of robot {robot}')
            axes.plot([x, found_x], [y, found_y], color=own.colour, linewidth=0.4)
            axes.plot(x, y, '.', color='black', markersize=2,
                      label='odometry' if not index else None)
        axes.plot([-0.5, 0.5], [10, 10], color='black', linewidth=3, label='surface')
        axes.set(xlabel='x of the map [m]', ylabel='y of the map [m]', aspect='equal')
        axes.legend(loc='center', bbox_to_anchor=(0.5, 0.65))
    write_picture(path, figure)


def main():
    """Run the simulation until each robot has the requested number of poses."""
    parser = argparse.ArgumentParser(description='Two robots in a simulation.')
    parser.add_argument('--rate', type=float, default=1.0, help='pace, relative to real time')
    parser.add_argument('--poses', type=int, default=0, help='poses of each robot; 0: endless')
    parser.add_argument('--picture', help='file for a picture: PNG, PDF or SVG')
    options, ros_arguments = parser.parse_known_args()
    rclpy.init(args=ros_arguments)
    node = Simulation(options.rate)
    try:
        while not options.poses or min(map(len, node.poses.values())) < options.poses:
            rclpy.spin_once(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        # A callback that runs while a signal shuts the context down can no longer publish.
        if rclpy.ok():
            raise
    if options.picture and all(node.poses.values()):
        draw(node.poses, options.picture)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
