"""ROS bags as files of ROS 2 messages in CDR, whatever is on disk.

    opening     opens any
    ros2_bag    a ROS 2 bag: its folder, its SQLite file
    ros1_bag    a ROS 1 bag

MCAP files are read by `share.recordings.mcap`.
"""

METADATA = "metadata.yaml"  # of the folder of a ROS 2 bag
