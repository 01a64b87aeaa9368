"""The configuration: every key with its unit and default. The effective configuration is written beside the
results of every run.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from share.plain_data import from_mapping
from share.retired_settings import refuse_retired


@dataclass(frozen=True)
class SequencerConfig:
    """Merging of streams by time."""

    sync_tolerance_ms: float = 5.0  # largest difference of the stamps of one frame's cameras
    imu_silent_ms: float = 100.0  # longest wait of a frame for partner images and IMU samples, in stream time
    reorder_ms: float = 0.0  # disorder within a stream that is corrected; delays frames by as much

    def __post_init__(self) -> None:
        _require_positive(self, "imu_silent_ms")


@dataclass(frozen=True)
class TrackerConfig:
    """Tracking by camera alone (`share.odometry.visual_tracker`)."""

    corners: int = 250  # features tracked at once
    spacing_px: float = 14.0  # least distance between corners
    view_features: int = 500  # ORB features of a keyframe, for other agents and for relocalisation
    noise_px: float = 1.0  # standard deviation of a tracked corner
    ransac_px: float = 3.0  # reprojection error of a RANSAC inlier
    gate_sigma: float = 3.0  # a measurement further off is an outlier
    min_inliers: int = 15  # features that agree with a pose; fewer: LOST
    weak_inliers: int = 40  # fewer: WEAK
    keyframe_m: float = 0.15  # motion since the last keyframe that triggers a new one
    keyframe_rad: float = 0.15  # rotation since the last keyframe that triggers a new one
    keyframe_tracked: float = 0.6  # a smaller share of its features still tracked triggers one too
    keyframe_gap_s: float = 0.1  # least time between keyframes
    max_keyframes: int = 60  # of the local map; a full one drops the keyframe closest to another
    reobserve_hosts: int = 6  # earlier keyframes whose points are searched for again
    reobserve_m: float = 1.0  # largest distance to such a keyframe
    reobserve_rad: float = 0.5  # largest rotation to such a keyframe
    reobserve_px: float = 3.0  # largest distance between the predicted and the found position of such a point
    relocalise_hosts: int = 8  # keyframes of the local map that a LOST frame is matched with
    new_stretch_s: float = 3.0  # LOST for this long: odometry starts a new segment
    max_speed_m_s: float = 5.0  # a pose that implies a higher speed is rejected
    max_turn_rad_s: float = 12.0  # a pose that implies a higher angular rate is rejected

    def __post_init__(self) -> None:
        _require_positive(self, "corners", "spacing_px", "view_features", "noise_px", "ransac_px")
        _require_positive(self, "gate_sigma", "min_inliers", "max_keyframes")


@dataclass(frozen=True)
class InertialConfig:
    """Tracking by cameras and IMU (`share.odometry`)."""

    features: int = 80  # features tracked at once
    spacing_px: float = 18.0  # least distance between new features
    sigma_px: float = 0.15  # noise of a feature's position, independent in each image
    lasting_px: float = 0.3  # persistent error of a feature: edges, patches seen from elsewhere
    stereo_px: float = 0.25  # noise of a new feature's disparity
    common_rad: float = 1e-3  # error of an image that all its features share (blur, time offset)
    common_m: float = 1e-4  # the same, as a shift of the camera
    gate: float = 12.0  # squared Mahalanobis distance (2 dof) above which a measurement is rejected
    alike: float = 0.85  # correlation with the first patch below which a feature is not found
    settled_px: float = 0.3  # alignment has converged if its last step is smaller than this
    reach_px: float = 4.0  # largest distance of an alignment from the predicted position
    imu_noise: float = 2.0  # multiple of the IMU's data-sheet noise
    gyro_bias: float = 0.02  # rad/s, initial standard deviation
    accel_bias: float = 0.3  # m/s^2, initial standard deviation
    extrinsic_rad: float = 1e-5  # standard deviation of the camera-to-body rotation; small: as calibrated
    extrinsic_m: float = 1e-5  # the same, of its position
    offset_s: float = 1e-6  # the same, of its time offset to the IMU
    gravity: float = 9.81  # m/s^2
    keyframe_m: float = 0.25  # motion since the last keyframe that triggers a new one
    keyframe_rad: float = 0.35  # rotation since the last keyframe that triggers a new one
    keyframe_seen: float = 0.8  # a smaller share of its features in use triggers one too
    keyframe_gap_s: float = 0.1  # least time between keyframes
    max_keyframes: int = 20  # in the state
    recall: int = 80  # features of earlier keyframes that a keyframe searches for again
    recall_m: float = 1.5  # largest distance to such a keyframe
    recall_rad: float = 0.7  # largest rotation to such a keyframe
    weak: int = 25  # features in use; fewer: WEAK
    blind: int = 6  # features in use; fewer: INERTIAL_ONLY
    max_speed_m_s: float = 8.0  # a faster state is LOST
    lost_m: float = 0.5  # position sigma since the last measurement at which the state is LOST
    silent_s: float = 0.1  # the IMU counts as silent after this long without a sample
    turning_noise: float = 0.5  # rad/s/sqrt(Hz), process noise of the angular rate while the IMU is silent
    moving_noise: float = 1.0  # m/s^2/sqrt(Hz), process noise of the velocity while the IMU is silent

    def __post_init__(self) -> None:
        _require_positive(self, "features", "spacing_px", "sigma_px", "gate", "imu_noise", "gravity")
        _require_positive(self, "max_keyframes")


@dataclass(frozen=True)
class PlaceConfig:
    """Verification that two views show the same place."""

    candidates: int = 8  # keyframes verified per query, best first; more find more loops and take longer
    min_inliers: int = 20  # matches that agree with the relative pose; fewer: refused

    def __post_init__(self) -> None:
        _require_positive(self, "candidates", "min_inliers")


@dataclass(frozen=True)
class AgentConfig:
    """The agent: keyframes, corrections, error model."""

    keep_keyframes: int = 600  # keyframes kept, sent ones included, to resend to a restarted edge
    late_ms: float = 0.0  # frames later than this are skipped; 0: none
    blend_s: float = 0.5  # duration of the blend
    finish_s: float = 5.0  # longest wait for acknowledgements at the end of a run
    error_model: str = "shipped"  # error model: shipped, a file, or "" for odometry's covariance

    def __post_init__(self) -> None:
        _require_positive(self, "keep_keyframes", "blend_s")
        if not self.late_ms >= 0:
            raise ValueError(f"late_ms: {self.late_ms} must not be negative")


@dataclass(frozen=True)
class LinkConfig:
    """The link between agent and edge."""

    silent_s: float = 3.0  # no message for this long: the edge counts as gone
    window: int = 16  # keyframes in flight

    def __post_init__(self) -> None:
        _require_positive(self, "silent_s", "window")


@dataclass(frozen=True)
class StreamConfig:
    """Streaming of frames to an edge that tracks them (policy streamed)."""

    window: int = 3  # frames in flight per agent, and as many at its tracker; beyond, the newest waits
    patience_s: float = 1.0  # a frame without an answer for this long counts as unanswered

    def __post_init__(self) -> None:
        _require_positive(self, "window", "patience_s")


@dataclass(frozen=True)
class ClockConfig:
    """The edge's clock as the agent reports it."""

    claim_ms: float = 1.0  # an offset with a larger uncertainty is not reported (docs/do/sync.md)

    def __post_init__(self) -> None:
        _require_positive(self, "claim_ms")


@dataclass(frozen=True)
class GraphConfig:
    """Solution of the pose graph."""

    cauchy: float = 3.0  # whitened residual (6 dof: 2.4 is usual) at which a loop begins to lose weight

    def __post_init__(self) -> None:
        _require_positive(self, "cauchy")


@dataclass(frozen=True)
class MergeConfig:
    """Acceptance of loops and merging of maps."""

    join_places: int = 2  # places that must agree before maps merge; of a smaller map, all but one
    overlap_pairs: int = 0  # least number of overlapping view pairs before maps merge, where rooms are copies
    odometry_scale: float = 1.0  # agents' standard deviations are too small by this factor
    enter_m: float = 0.05  # an agent with a larger map position sigma waits for its correction
    scale_tolerance: float = 0.015  # agents whose depths or path lengths differ by more are quarantined

    def __post_init__(self) -> None:
        _require_positive(self, "join_places", "odometry_scale", "scale_tolerance")


STREAMED = "streamed"
POLICY_NAMES = ("share", "covins-g", "linear", "equal", "random", STREAMED)  # see `share.scheduling.policies`


@dataclass(frozen=True)
class EdgeConfig:
    """Limits of the edge."""

    policy: str = "share"  # overridden by `share edge --policy`
    silent_s: float = 3.0  # no message of an agent for this long: it counts as gone
    max_agents: int = 64  # present at once; more are refused
    max_keyframes: int = 2000  # kept; beyond, the agent with most gives up redundant ones first
    max_waiting: int = 12  # queued queries; beyond, the oldest keyframe is only stored

    def __post_init__(self) -> None:
        if self.policy not in POLICY_NAMES:
            raise ValueError(f"policy: '{self.policy}' is not known; known: {', '.join(POLICY_NAMES)}")
        _require_positive(self, "max_agents", "max_keyframes", "max_waiting")


@dataclass(frozen=True)
class AgentQoe:
    """QoE parameters of one agent, under its name in `control.agents`; None: the default of its form."""

    form: str | None = None  # ar or robot; None: its kind
    beta: float | None = None
    gamma: float | None = None
    theta_ms: float | None = None
    target: float | None = None

    def __post_init__(self) -> None:
        if self.form not in (None, "ar", "robot"):
            raise ValueError(f"form: '{self.form}' is not known; known: ar, robot")
        _require_positive(self, *(name for name in ("gamma", "theta_ms") if getattr(self, name) is not None))


@dataclass(frozen=True)
class ControlConfig:
    """QoE, keyframe rates and the merge gate (docs/understand/scheduling.md)."""

    ar_beta: float = 0.015  # 1/ms, of delay above 20 ms
    ar_gamma: float = 3.6  # cm, of accuracy
    ar_target: float = 0.93  # target QoE
    robot_beta: float = 3.0  # cm, of accuracy below 1/cm
    robot_gamma: float = 400.0  # ms, of 1 / (delay + theta)
    robot_theta_ms: float = 20.0  # delays well below this are equally good
    robot_target: float = 0.9  # target QoE
    signed_penalty: bool = False  # allow negative penalties, with QoE above 1, as printed in the paper
    agents: dict[str, AgentQoe] = field(default_factory=dict)  # NAME: {form, beta, gamma, theta_ms, target}
    attribution: bool = True  # a QoE that is low because of delay lowers the rate, unlike in the paper
    kp: float = 0.8  # Hz per evaluation, of an error of 1 in QoE
    ki: float = 0.15  # the same, of an error of 1 for a second
    kd: float = 0.2  # the same, of an error that grows by 1 in a second
    alpha: float = 0.3  # weight of the newest derivative of the error, of 1
    rate_min_hz: float = 1.5  # lowest rate of an agent
    rate_max_hz: float = 5.0  # highest rate of an agent, and its initial one
    random_seed: int = 1  # of the merge gate and of policy random
    near_m: float = 0.3  # near plane of the view frusta
    far_m: float = 5.0  # far plane of the view frusta
    merges: int = 20  # completed merges in the mean overlap that a new one is compared with (N)
    eagerness: float = 1.5  # a merge has this probability times its overlap over their mean (alpha_m)

    def __post_init__(self) -> None:
        _require_positive(self, "ar_gamma", "robot_gamma", "robot_theta_ms", "rate_min_hz", "merges")
        if not self.near_m < self.far_m:
            raise ValueError(f"near_m: {self.near_m} m is not nearer than far_m, {self.far_m} m")
        if not (self.rate_min_hz <= self.rate_max_hz <= 1000 and self.alpha <= 1):
            raise ValueError("rate_min_hz, rate_max_hz, 1000 must rise, and alpha be at most 1")


@dataclass(frozen=True)
class Config:
    """The whole configuration, one section per part."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    sequencer: SequencerConfig = field(default_factory=SequencerConfig)
    place: PlaceConfig = field(default_factory=PlaceConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    edge: EdgeConfig = field(default_factory=EdgeConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)


def _require_positive(config: Any, *names: str) -> None:
    for name in names:
        if not getattr(config, name) > 0:
            raise ValueError(f"{name}: {getattr(config, name)} must be positive")


def load_config(text: str, where: str = "configuration") -> Config:
    """Return a `Config` from YAML text. Raises ConfigError naming the key and the remedy."""
    from share.strict_yaml import load_yaml

    data = load_yaml(text, where)
    refuse_retired(data, where)
    return from_mapping(Config, {} if data is None else data, where)
