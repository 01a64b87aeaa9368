"""Export of a recording, run or map (poses, points, images) to formats of other programs.

scene           what is exported, whatever it comes from
names           names of files, folders, topics and frames
kitti           poses of cam0
colmap          a COLMAP text model, for structure from motion and Gaussian splatting
mcap_scene      ROS 2 messages, for Foxglove and RViz
rerun_file      a recording for the Rerun viewer
"""
