"""MCAP recordings with ROS 2 messages: files, messages, rigs, writing and recovery."""
