"""Odometry of one agent: frames in, poses and keyframes out (docs/understand/odometry.md).

Begin with `inertial_tracker.InertialTracker.track`. A frame's way, in the order of the calls:

    imu_predictor        propagate the state to the image (`imu_propagation`, `imu_outliers`)
    feature_matching     predict the features' positions and align their patches (`feature_appearance`)
    rest_detection       a zero-velocity update where IMU and images show none of a motion
    visual_update        reject what moves in the room, linearise, gate, update
    health               the state of the result: OK, WEAK, LOST
    keyframes            work after the pose, in slices: surfaces to publish, new features (`landmarks`)

The EKF is in `filter` (its steps) and `state` (means and covariance: the body, keyframes as clones, and the
inverse depth of each feature in its anchor keyframe). Features get their first depth in `initial_depth`;
those out of view rest in `dormant_features`. The beginning: `initialisation`; of a single camera:
`mono_initialisation`, which fits a window (`mono_bundle`) from a linear start (`mono_shooting`).
`tilt_realignment` keeps published poses continuous. After a loss: `relocalisation`. Rigs without IMU:
`visual_tracker`. The agent's own estimate of its error: `error_model`.

To change:

    the gate             `filter.GATE`, applied in `visual_update._gate`; to features that come back in
                         `landmarks`, at rest in `filter.zero_velocity_update`
    dynamic features     `visual_update.mark_dynamic`
    new features         `landmarks`, `share.vision.corners`; their number: `inertial.features`
    the patches          `feature_appearance`, `share.vision.patches`
    state and update     `state`, `filter.update`, `filter.propagate`
    the noise            `inertial.sigma_px`, `inertial.imu_noise`
    keyframe spacing     `keyframes`; `inertial.keyframe_m`, `inertial.keyframe_rad`
"""
