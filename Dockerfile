# The network on ROS 2 Jazzy:
#   docker build -t rhs_isac_ros .
#   docker run --rm -it rhs_isac_ros
# Processes of one host discover each other with multicast; between containers, use `--network host`.
FROM ros:jazzy-ros-base

WORKDIR /ws
COPY . src/rhs_isac_ros
# Neither colcon nor rosdep searches for packages inside a package.
RUN ln -s rhs_isac_ros/msg_defs src/rhs_isac_msgs \
 && apt-get update \
 && rosdep update --rosdistro "$ROS_DISTRO" \
 && rosdep install --from-paths src --ignore-src --default-yes \
 && apt-get install --yes --no-install-recommends python3-pip \
 # Recordings: libraries without a rosdep key.
 && python3 -m pip install --no-cache-dir --break-system-packages -r src/rhs_isac_ros/requirements-recording.txt \
 && rm -rf /var/lib/apt/lists/*
RUN . "/opt/ros/$ROS_DISTRO/setup.sh" && colcon build && rm -r log

# The entry point of the image sources only ROS.
ENTRYPOINT ["/bin/sh", "-c", ". /ws/install/setup.sh && exec \"$@\"", "--"]
CMD ["ros2", "launch", "rhs_isac_ros", "network.launch.py"]
