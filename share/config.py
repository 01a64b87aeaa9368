"""The configuration: every key with its unit and default. The effective configuration is written beside the
results of every run.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from share.plain_data import from_mapping, load_yaml
from share.retired_settings import refuse_retired


@dataclass(frozen=True)
class SequencerConfig:
    """Merging of streams by time."""

    sync_tolerance_ms: float = 5.0  # largest difference of the stamps of one frame's cameras
    imu_silent_ms: float = 100.0  # longest wait of a frame for partner images and IMU samples, in stream time
    reorder_ms: float = 0.0  # disorder within a stream that is corrected; delays frames by as much
    gap_factor: float = 2.5  # a step longer than this many frame intervals is a gap
    max_jump_s: float = 10.0  # a longer step is accepted after three consistent samples; a backward one never

    def __post_init__(self) -> None:
        _require_positive(self, "imu_silent_ms", "gap_factor", "max_jump_s")


@dataclass(frozen=True)
class TrackerConfig:
    """Tracking by cameras alone (`share.odometry.visual_tracker`); the views and loss of any tracker."""

    corners: int = 250  # features tracked at once
    view_features: int = 500  # ORB features of a keyframe, for other agents and for relocalisation
    new_stretch_s: float = 3.0  # LOST for this long: odometry starts a new segment

    def __post_init__(self) -> None:
        _require_positive(self, "corners", "view_features")


@dataclass(frozen=True)
class InertialConfig:
    """Tracking by cameras and IMU (`share.odometry`)."""

    features: int = 80  # features tracked at once
    sigma_px: float = 0.15  # noise of a feature's position, independent in each image
    imu_noise: float = 2.0  # multiple of the IMU's data-sheet noise
    gyro_bias: float = 0.02  # rad/s, initial standard deviation
    accel_bias: float = 0.3  # m/s^2, initial standard deviation
    gravity: float = 9.81  # m/s^2
    keyframe_m: float = 0.25  # motion since the last keyframe that triggers a new one
    keyframe_rad: float = 0.35  # rotation since the last keyframe that triggers a new one
    max_keyframes: int = 20  # in the state
    max_speed_m_s: float = 8.0  # a faster state is LOST

    def __post_init__(self) -> None:
        _require_positive(self, "features", "sigma_px", "imu_noise", "gravity")
        _require_positive(self, "max_keyframes")


@dataclass(frozen=True)
class PlaceConfig:
    """Verification that two views show the same place."""

    candidates: int = 8  # keyframes verified per query, best first
    enough: int = 3  # verified candidates after which the search ends
    tables: int = 8  # hash tables of the index
    hash_bits: int = 16  # descriptor bits that form a word in each table
    index_seed: int = 1  # seed for the choice of these bits
    max_distance_bits: int = 64  # largest Hamming distance of a match, of 256
    min_matches: int = 20  # mutual nearest neighbours required before geometry is tried
    ransac_px: float = 6.0  # reprojection error of a RANSAC inlier
    ransac_iterations: int = 300  # at most, best matches first
    reverse_iterations: int = 900  # the same, of the reverse direction, in random order
    min_consensus: int = 8  # RANSAC inliers: 3-D points of one view in the other's image
    guided_bits: int = 80  # largest Hamming distance of a match found near its predicted position
    guided_px: float = 15.0  # largest distance from the predicted position of such a match
    agree_depth_ratio: float = 0.05  # poses are equal if positions differ by less than this times the depth
    agree_deg: float = 2.5  # and their rotations by less than this
    rival_share: float = 0.5  # another pose with more than this share of the inliers: refused
    sigma_px: float = 1.5  # standard deviation of a keypoint
    sigma_inverse_depth: float = 0.01  # 1/m, of a keypoint's depth: disparity noise / (focal * baseline)
    inlier_chi2: float = 11.3  # squared Mahalanobis distance of an inlier (99 %, 3 degrees of freedom)
    min_inliers: int = 20  # after refinement; fewer: refused
    min_direction_inliers: int = 10  # the same, per direction: with the query's depths, with the candidate's
    max_sigma_deg: float = 0.5  # a pose with a larger standard deviation is refused
    min_spread: float = 0.05  # narrow side (1 sigma) of the inliers, normalised coordinates
    gravity_deg: float = 6.0  # largest difference of the two gravity directions, where both are known
    floor_deg: float = 0.1  # added to the covariance: errors that inliers do not average out
    floor_m: float = 0.005  # the same, for the position

    def __post_init__(self) -> None:
        _require_positive(self, "candidates", "enough", "tables", "hash_bits", "ransac_px")
        _require_positive(self, "ransac_iterations", "reverse_iterations", "guided_px")
        _require_positive(self, "sigma_px", "sigma_inverse_depth", "inlier_chi2")
        if self.tables << self.hash_bits > 1 << 22:
            raise ValueError(f"hash_bits: {self.tables} tables of {self.hash_bits} bits are too many words")


@dataclass(frozen=True)
class AgentConfig:
    """The agent: keyframes, corrections, error model."""

    keep_keyframes: int = 600  # keyframes kept, sent ones included, to resend to a restarted edge
    late_ms: float = 0.0  # frames later than this are skipped; 0: none
    rate_burst: float = 2.0  # keyframes that may be saved up under a rate limit
    blend_jump_m: float = 0.05  # a correction that moves the body further is blended in
    blend_jump_rad: float = 0.02  # a correction that rotates it further is blended in
    blend_s: float = 0.5  # duration of the blend
    finish_s: float = 5.0  # longest wait for acknowledgements at the end of a run
    error_model: str = "shipped"  # error model: shipped, a file, or "" for odometry's covariance
    tell_placement: bool = True  # add the agent's map position sigma to the error sent to the edge

    def __post_init__(self) -> None:
        _require_positive(self, "keep_keyframes", "blend_s")
        if not self.late_ms >= 0:
            raise ValueError(f"late_ms: {self.late_ms} must not be negative")
        if self.rate_burst < 1:
            raise ValueError(f"rate_burst: {self.rate_burst} must be at least 1")


@dataclass(frozen=True)
class LinkConfig:
    """Timing of the link between agent and edge."""

    hello_s: float = 0.5  # interval of hellos, until welcomed
    refused_s: float = 5.0  # a running agent that was refused asks again after this
    ping_s: float = 0.5  # interval of pings
    silent_s: float = 3.0  # no message for this long: the edge counts as gone
    window: int = 16  # keyframes in flight
    resend_s: float = 1.0  # first wait for an acknowledgement; doubles with each resend
    resend_max_s: float = 8.0  # longest wait
    gap_s: float = 0.1  # first wait for a keyframe that later ones have overtaken

    def __post_init__(self) -> None:
        _require_positive(self, "hello_s", "ping_s", "silent_s", "window", "resend_s", "resend_max_s")


@dataclass(frozen=True)
class StreamConfig:
    """Streaming of frames to an edge that tracks them (policy streamed)."""

    window: int = 3  # frames in flight per agent, and as many at its tracker; beyond, the newest waits
    patience_s: float = 1.0  # a frame without an answer for this long counts as unanswered
    begin_s: float = 20.0  # longest wait of a recording for the edge's tracker before it plays

    def __post_init__(self) -> None:
        _require_positive(self, "window", "patience_s")


@dataclass(frozen=True)
class ClockConfig:
    """The filter of the edge's clock relative to the agent's."""

    noise_us: float = 20.0  # standard deviation of an exchange that was not queued
    asymmetry: float = 0.5  # error of an offset as a share of the delay above the minimum; 0.5 is the bound
    offset_walk_us: float = 4.0  # random walk of the offset, per sqrt(s)
    drift_walk_ppm: float = 0.05  # random walk of the drift, per sqrt(s)
    drift_ppm: float = 100.0  # initial standard deviation of the drift
    least_of: int = 64  # recent exchanges among which the minimum delay is taken
    gate_sigma: float = 4.0  # an exchange further off is rejected
    step_after: int = 5  # rejected exchanges in a row after which the filter restarts: the clock was set
    claim_ms: float = 1.0  # an offset with a larger uncertainty is not reported (docs/do/sync.md)

    def __post_init__(self) -> None:
        _require_positive(self, "noise_us", "drift_ppm", "least_of", "gate_sigma", "step_after", "claim_ms")


@dataclass(frozen=True)
class GraphConfig:
    """Solution of the pose graph."""

    cauchy: float = 3.0  # whitened residual (6 dof: 2.4 is usual) at which a loop begins to lose weight
    max_iterations: int = 30  # of Levenberg-Marquardt; the next solution continues from the result
    relative_tolerance: float = 1e-6  # of the cost, between two iterations
    step_tolerance: float = 3e-3  # rad and m; converged once no pose moves by more
    inner_tolerance: float = 3e-2  # relative residual of the linear system of a step
    covariance_edges: int = 250  # surest edges used for covariances; more: tighter and slower
    covariance_rounds: int = 16  # rounds of the search for shortest covariance paths, at most

    def __post_init__(self) -> None:
        _require_positive(self, *(setting.name for setting in fields(self)))


@dataclass(frozen=True)
class MergeConfig:
    """Acceptance of loops and merging of maps."""

    min_loop_gap: int = 10  # keyframes of one segment closer than this make no loop
    agree_chi2: float = 22.5  # two loops agree, or a loop fits the map (99.9 %, 6 dof)
    surprise_chi2: float = 200.0  # above this a loop contradicts the map whatever supporting loops there are
    odometry_scale: float = 1.0  # agents' standard deviations are too small by this factor
    odometry_floor_deg: float = 0.002  # per edge, added in quadrature
    odometry_floor_m: float = 0.0002  # the same, for the position
    odometry_floor_per_rad: float = 0.0005  # the same, per rad that the edge rotates
    odometry_floor_per_m: float = 0.003  # the same, per m that the edge moves
    gravity_floor_deg: float = 0.1  # the same, of a gravity factor: error of the IMU calibration
    most_loops: int = 10  # loops of a keyframe that loops of removed keyframes may be moved to
    max_pending: int = 200  # pending loops; the oldest is dropped
    place_m: float = 0.5  # views further apart than this are different places
    place_rad: float = 0.35  # views rotated further than this are different places
    near_m: float = 2.5  # views further apart than this do not support a merge
    near_rad: float = 0.8  # views rotated further than this do not support a merge
    join_places: int = 2  # places that must agree before maps merge; of a smaller map, all but one
    join_found: float = 0.3  # share of the common points that must be found, on average
    overlap_pairs: int = 0  # least number of overlapping view pairs for the overlap check
    overlap_gone: float = 0.06  # largest share of the common points that may be missing
    undo_doubt: float = 0.6  # CUSUM of the missing share above that; more forbids or undoes a merge
    rival_weight: float = 0.5  # a competing hypothesis with more than this share of the weight blocks a merge
    enter_m: float = 0.05  # an agent with a larger map position sigma waits for its correction
    enter_patience: int = 20  # but at most for this many of its keyframes with loops
    rebel_places: int = 4  # contradicting loops split a map from this many places on
    rebel_weight: float = 1.4  # and from this multiple of the existing loops' weight on
    scale_tolerance: float = 0.015  # agents whose depths or path lengths differ by more are quarantined
    drop_chi2: float = 1000.0  # loops with a larger chi-squared after a solution are dropped

    def __post_init__(self) -> None:
        _require_positive(self, "min_loop_gap", "most_loops", "max_pending")


STREAMED = "streamed"
POLICY_NAMES = ("share", "covins-g", "linear", "equal", "random", STREAMED)  # see `share.scheduling.policies`


@dataclass(frozen=True)
class EdgeConfig:
    """Limits of the edge."""

    policy: str = "share"  # overridden by `share edge --policy`
    silent_s: float = 3.0  # no message of an agent for this long: it counts as gone
    name_hold_s: float = 3.0  # a name stays in use for this long after its agent's last message
    max_agents: int = 64  # present at once; more are refused
    max_keyframes: int = 2000  # kept; beyond, the agent with most gives up redundant ones first
    max_waiting: int = 12  # queued queries; beyond, the oldest keyframe is only stored
    each_waiting: int = 3  # the same, of one agent
    hurry_waiting: int = 1  # with this many queued, a query verifies fewer candidates
    hurry_candidates: int = 3  # at most these, and the first verified one ends the search

    def __post_init__(self) -> None:
        if self.policy not in POLICY_NAMES:
            raise ValueError(f"policy: '{self.policy}' is not known; known: {', '.join(POLICY_NAMES)}")
        _require_positive(self, "max_agents", "max_keyframes", "max_waiting", "each_waiting")
        _require_positive(self, "hurry_waiting", "hurry_candidates")


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
    integral_max_hz: float = 0.1  # bound of the integral term
    rate_min_hz: float = 1.5  # lowest rate of an agent
    rate_max_hz: float = 5.0  # highest rate of an agent, and its initial one
    gap_s: float = 5.0  # without an evaluation for longer, the derivative is reset and the integral held
    random_seed: int = 1  # of policy random
    gate_seed: int = 1  # of the merge gate
    near_m: float = 0.3  # near plane of the view frusta
    far_m: float = 5.0  # far plane of the view frusta
    interval_m: float = 0.5  # spacing of the points at which overlap is sampled
    merges: int = 20  # completed merges in the mean overlap that a new one is compared with (N)
    eagerness: float = 1.5  # a merge has this probability times its overlap over their mean (alpha_m)

    def __post_init__(self) -> None:
        _require_positive(self, "ar_gamma", "robot_gamma", "robot_theta_ms", "rate_min_hz", "merges")
        _require_positive(self, "interval_m")
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
    data = load_yaml(text, where)
    refuse_retired(data, where)
    return from_mapping(Config, {} if data is None else data, where)
