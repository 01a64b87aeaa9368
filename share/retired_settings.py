"""Settings of earlier releases that are constants now, and where each is."""

from __future__ import annotations

from typing import Any

from share.errors import ConfigError

# "section.key": "module.CONSTANT", of the modules below `share`
RETIRED_SETTINGS: dict[str, str] = {
    # tracker
    "tracker.spacing_px": "odometry.visual_tracker._SPACING_PX",
    "tracker.noise_px": "odometry.relocalisation.NOISE_PX",
    "tracker.ransac_px": "odometry.relocalisation.RANSAC_PX",
    "tracker.gate_sigma": "odometry.relocalisation.GATE_SIGMA",
    "tracker.min_inliers": "odometry.relocalisation.MIN_INLIERS",
    "tracker.weak_inliers": "odometry.visual_tracker._WEAK_INLIERS",
    "tracker.keyframe_m": "odometry.visual_tracker.KEYFRAME_M",
    "tracker.keyframe_rad": "odometry.visual_tracker.KEYFRAME_RAD",
    "tracker.keyframe_tracked": "odometry.visual_tracker._MIN_TRACKED_SHARE",
    "tracker.keyframe_gap_s": "odometry.keyframes.KEYFRAME_GAP_NS",
    "tracker.max_keyframes": "odometry.relocalisation.MAX_KEYFRAMES",
    "tracker.reobserve_hosts": "odometry.visual_tracker._REOBSERVED_KEYFRAMES",
    "tracker.reobserve_m": "odometry.visual_tracker._REOBSERVE_M",
    "tracker.reobserve_rad": "odometry.visual_tracker._REOBSERVE_RAD",
    "tracker.reobserve_px": "odometry.visual_tracker._REOBSERVE_PX",
    "tracker.relocalise_hosts": "odometry.relocalisation._BATCH_SIZE",
    "tracker.max_speed_m_s": "odometry.visual_tracker._MAX_SPEED_M_S",
    "tracker.max_turn_rad_s": "odometry.visual_tracker._MAX_TURN_RAD_S",
    # inertial
    "inertial.spacing_px": "odometry.landmarks._SPACING_PX",
    "inertial.lasting_px": "odometry.landmarks.LASTING_PX",
    "inertial.stereo_px": "odometry.initial_depth._STEREO_PX",
    "inertial.common_rad": "odometry.visual_update.COMMON_COV",
    "inertial.common_m": "odometry.visual_update.COMMON_COV",
    "inertial.gate": "odometry.filter.GATE",
    "inertial.alike": "odometry.feature_matching._MIN_CORRELATION",
    "inertial.settled_px": "odometry.feature_matching._MAX_LAST_STEP_PX",
    "inertial.reach_px": "odometry.feature_matching._MAX_REACH_PX",
    "inertial.extrinsic_rad": "odometry.initialisation.EXTRINSIC_SIGMA_RAD",
    "inertial.extrinsic_m": "odometry.initialisation.EXTRINSIC_SIGMA_M",
    "inertial.offset_s": "odometry.initialisation._TIMESHIFT_SIGMA_S",
    "inertial.keyframe_seen": "odometry.keyframes._MIN_SEEN_SHARE",
    "inertial.keyframe_gap_s": "odometry.keyframes.KEYFRAME_GAP_NS",
    "inertial.recall": "odometry.dormant_features._MAX_SEARCHED",
    "inertial.recall_m": "odometry.dormant_features._MAX_DISTANCE_M",
    "inertial.recall_rad": "odometry.dormant_features._MAX_ANGLE_RAD",
    "inertial.weak": "odometry.health.WEAK",
    "inertial.blind": "odometry.health.BLIND",
    "inertial.lost_m": "odometry.health._MAX_DRIFT_M",
    "inertial.silent_s": "odometry.imu_predictor._SILENT_NS",
    "inertial.turning_noise": "odometry.imu_predictor._TURNING_NOISE",
    "inertial.moving_noise": "odometry.imu_predictor._MOVING_NOISE",
    # sequencer
    # place
    # graph
    # merge
    # edge
    # control
    # agent
    # link
    # stream
    # clock
}


def refuse_retired(data: Any, where: str) -> None:
    """Raise ConfigError for the first retired setting of a configuration (mapping of sections)."""
    for section, settings in data.items() if isinstance(data, dict) else ():
        for key in settings if isinstance(settings, dict) else ():
            if constant := RETIRED_SETTINGS.get(f"{section}.{key}"):
                module, _, name = constant.rpartition(".")
                place = f"{name} in share/{module.replace('.', '/')}.py"
                raise ConfigError(
                    f"{where}: {section}.{key} is no longer a setting: it is {place}; remove the line"
                )
