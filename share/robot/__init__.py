"""A robot with ROS 2 navigation on SHARE's poses: `map → odom` and goals, without ROS in SHARE.

`bridge.RobotBridge` decides, as a state machine without clock, socket or thread: it takes the agent's poses
(`pose_message`) and the robot's odometry, and says what to publish and which goal to send. `ros_node` and
`navigate` carry that out by DDS (`ros_types`), imported only when a bridge runs.

Frames: the map is SHARE's. "odom" here is the robot's, of its wheels, as in ROS; an agent's odom, of
visual-inertial odometry, is another frame, which no robot sees. The base is ROS's base_link: x ahead, y left,
z up.
"""
