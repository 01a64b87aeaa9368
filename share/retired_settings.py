"""Settings of earlier releases that are constants now, and where each is."""

from __future__ import annotations

from typing import Any

from share.errors import ConfigError

# "section.key": "module.CONSTANT", of the modules below `share`
RETIRED_SETTINGS: dict[str, str] = {
    # tracker
    "tracker.spacing_px": "odometry.visual_tracker._SPACING_PX",
    "tracker.view_features": "odometry.relocalisation.VIEW_FEATURES",
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
    "tracker.new_stretch_s": "odometry.relocalisation.NEW_SEGMENT_S",
    "tracker.max_turn_rad_s": "odometry.visual_tracker._MAX_TURN_RAD_S",
    # inertial
    "inertial.spacing_px": "odometry.landmarks._SPACING_PX",
    "inertial.lasting_px": "odometry.landmarks.CORRELATED_SIGMA_PX",
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
    "inertial.weak": "odometry.health.MIN_OK_FEATURES",
    "inertial.blind": "odometry.health.MIN_POSE_FEATURES",
    "inertial.lost_m": "odometry.health._MAX_DRIFT_M",
    "inertial.silent_s": "odometry.imu_predictor._SILENT_NS",
    "inertial.turning_noise": "odometry.imu_predictor._TURNING_NOISE",
    "inertial.moving_noise": "odometry.imu_predictor._MOVING_NOISE",
    # sequencer
    "sequencer.gap_factor": "sensors.stamps.GAP_FACTOR",
    "sequencer.max_jump_s": "sensors.stamps.MAX_JUMP_S",
    # place
    "place.enough": "mapping.candidates.MAX_VERIFIED",
    "place.tables": "mapping.recognition.index.TABLES",
    "place.hash_bits": "mapping.recognition.index.HASH_BITS",
    "place.index_seed": "mapping.recognition.index.SEED",
    "place.max_distance_bits": "mapping.recognition.verification.MAX_BITS",
    "place.min_matches": "mapping.recognition.verification.MIN_MATCHES",
    "place.ransac_px": "mapping.recognition.verification.RANSAC_PX",
    "place.ransac_iterations": "mapping.recognition.verification._RANSAC_ITERATIONS",
    "place.reverse_iterations": "mapping.recognition.verification._REVERSE_ITERATIONS",
    "place.min_consensus": "mapping.recognition.verification._MIN_CONSENSUS",
    "place.guided_bits": "mapping.recognition.verification.GUIDED_BITS",
    "place.guided_px": "mapping.recognition.verification.GUIDED_PX",
    "place.agree_depth_ratio": "mapping.recognition.verification._AGREE_DEPTH_RATIO",
    "place.agree_deg": "mapping.recognition.verification._AGREE_DEG",
    "place.rival_share": "mapping.recognition.verification._COMPETING_SHARE",
    "place.sigma_px": "mapping.recognition.verification.SIGMA_PX",
    "place.sigma_inverse_depth": "mapping.recognition.verification.SIGMA_INVERSE_DEPTH",
    "place.inlier_chi2": "mapping.recognition.verification.INLIER_CHI2",
    "place.min_inliers": "mapping.recognition.verification.MIN_INLIERS",
    "place.min_direction_inliers": "mapping.recognition.verification.MIN_DIRECTION_INLIERS",
    "place.max_sigma_deg": "mapping.recognition.verification.MAX_SIGMA_DEG",
    "place.min_spread": "mapping.recognition.verification.MIN_SPREAD",
    "place.gravity_deg": "mapping.recognition.verification.GRAVITY_DEG",
    "place.floor_deg": "mapping.recognition.verification._FLOOR_DEG",
    "place.floor_m": "mapping.recognition.verification._FLOOR_M",
    # graph
    "graph.cauchy": "mapping.graph.solver.CAUCHY_WIDTH",
    "graph.max_iterations": "mapping.graph.optimiser.MAX_ITERATIONS",
    "graph.relative_tolerance": "mapping.graph.optimiser.RELATIVE_TOLERANCE",
    "graph.step_tolerance": "mapping.graph.optimiser.STEP_TOLERANCE",
    "graph.inner_tolerance": "mapping.graph.optimiser.INNER_TOLERANCE",
    "graph.covariance_edges": "mapping.graph.covariance.MAX_EDGES",
    "graph.covariance_rounds": "mapping.graph.covariance._MAX_ROUNDS",
    # merge
    "merge.min_loop_gap": "mapping.segments.MIN_LOOP_GAP",
    "merge.agree_chi2": "mapping.loop_acceptance.AGREE_CHI2",
    "merge.surprise_chi2": "mapping.loop_acceptance._CONTRADICT_CHI2",
    "merge.max_pending": "mapping.loop_acceptance._MAX_PENDING",
    "merge.join_found": "mapping.loop_acceptance.JOIN_FOUND",
    "merge.overlap_gone": "mapping.overlap_check.SAME_DAY",
    "merge.undo_doubt": "mapping.loop_acceptance._UNDO_CUSUM",
    "merge.rival_weight": "mapping.loop_acceptance._COMPETING_WEIGHT",
    "merge.rebel_places": "mapping.loop_acceptance._CONTRADICTING_PLACES",
    "merge.rebel_weight": "mapping.loop_acceptance._CONTRADICTING_WEIGHT",
    "merge.odometry_scale": "mapping.agents.covariance_scales.CovarianceScales",
    "merge.odometry_floor_deg": "mapping.graph.edges._STEP_FLOOR_DEG",
    "merge.odometry_floor_m": "mapping.graph.edges._STEP_FLOOR_M",
    "merge.odometry_floor_per_rad": "mapping.graph.edges._STEP_FLOOR_PER_RAD",
    "merge.odometry_floor_per_m": "mapping.graph.edges._STEP_FLOOR_PER_M",
    "merge.gravity_floor_deg": "mapping.graph.gravity._FLOOR_DEG",
    "merge.most_loops": "mapping.keyframe_removal.MAX_LOOPS",
    "merge.place_m": "mapping.loop_consistency.PLACE_M",
    "merge.place_rad": "mapping.loop_consistency.PLACE_RAD",
    "merge.near_m": "mapping.loop_consistency.NEAR_M",
    "merge.near_rad": "mapping.loop_consistency.NEAR_RAD",
    "merge.enter_patience": "mapping.localisation_gate.PATIENCE",
    "merge.drop_chi2": "mapping.map_solving._OUTLIER_CHI2",
    "merge.scale_tolerance": "mapping.agents.agent_pair.SCALE_TOLERANCE",
    # edge
    "edge.name_hold_s": "protocol.admission.NAME_HOLD_S",
    "edge.each_waiting": "mapping.query_queue.MAX_WAITING_EACH",
    "edge.hurry_waiting": "mapping.query_queue.MIN_BACKLOG",
    "edge.hurry_candidates": "mapping.candidates.MAX_BACKLOG_CANDIDATES",
    # control
    "control.alpha": "scheduling.policies.DERIVATIVE_WEIGHT",
    "control.near_m": "config.NEAR_M",
    "control.integral_max_hz": "scheduling.policies.INTEGRAL_MAX_HZ",
    "control.gap_s": "scheduling.policies.GAP_S",
    "control.interval_m": "scheduling.merge_gate.INTERVAL_M",
    # agent
    "agent.rate_burst": "protocol.keyframe_pace.RATE_BURST",
    "agent.blend_jump_m": "protocol.localisation.JUMP_M",
    "agent.blend_jump_rad": "protocol.localisation.JUMP_M",  # a rotation counts by its lever
    # link
    "link.window": "protocol.agent_ledger.WINDOW",
    "link.hello_s": "protocol.edge_connection.HELLO_S",
    "link.refused_s": "protocol.edge_connection.REFUSED_S",
    "link.ping_s": "protocol.edge_clock.PING_S",
    "link.resend_s": "protocol.agent_ledger.RESEND_S",
    "link.resend_max_s": "protocol.agent_ledger.RESEND_MAX_S",
    "link.gap_s": "protocol.agent_ledger.GAP_RESEND_S",
    # stream
    "stream.patience_s": "protocol.streaming.PATIENCE_S",
    "stream.begin_s": "runtime.frame_consumers.TRACKER_START_S",
    # clock
    "clock.noise_us": "protocol.edge_clock.NOISE_US",
    "clock.asymmetry": "protocol.edge_clock.ASYMMETRY",
    "clock.offset_walk_us": "protocol.edge_clock.OFFSET_WALK_US",
    "clock.drift_walk_ppm": "protocol.edge_clock.DRIFT_WALK_PPM",
    "clock.drift_ppm": "protocol.edge_clock.DRIFT_PPM",
    "clock.least_of": "protocol.edge_clock.LEAST_OF",
    "clock.gate_sigma": "protocol.edge_clock.STEP_AFTER",  # what contradicts the bounds is rejected
    "clock.step_after": "protocol.edge_clock.STEP_AFTER",
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
