"""ROS as a sink: ROS 1 by a child process of Debian's Python, ROS 2 by Cyclone DDS without ROS installed."""
