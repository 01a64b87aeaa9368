"""Images: corners, optical flow, patches, depth, ORB features and their matching."""
