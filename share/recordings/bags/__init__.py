"""ROS bags as files of ROS 2 messages in CDR, whatever is on disk.

    message_file    what a reader of messages offers; opens any
    split_bag       the folder of a ROS 2 bag, in one file or several
    sqlite_bag      a ROS 2 bag's SQLite file
    ros1_bag        a ROS 1 bag

MCAP files are read by `share.recordings.mcap`.
"""

METADATA = "metadata.yaml"  # of the folder of a ROS 2 bag
