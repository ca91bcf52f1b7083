"""Bags of ROS 1 and 2: their files, whole or cut off, and their messages as readings."""
