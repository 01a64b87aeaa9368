"""Every tunable of SHARE, its unit and its default. The effective configuration is written beside the
results of every run.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from share.plain_data import from_mapping, load_yaml


@dataclass(frozen=True)
class SequencerConfig:
    """How streams are merged by time."""

    sync_tolerance_ms: float = 5.0  # cameras of one frame lie within this
    imu_silent_ms: float = 100.0  # a frame waits this long (stream time) for partners and IMU samples
    reorder_ms: float = 0.0  # disorder within one stream that is put right; delays frames by as much
    gap_factor: float = 2.5  # a step longer than this many frame intervals is a gap
    max_jump_s: float = 10.0  # a longer step needs three witnesses to be believed, backward never is

    def __post_init__(self) -> None:
        _require_positive(self, "imu_silent_ms", "gap_factor", "max_jump_s")


@dataclass(frozen=True)
class TrackerConfig:
    """Tracking by camera alone (`share.odometry.visual_tracker`)."""

    corners: int = 250  # points tracked at a time
    spacing_px: float = 14.0  # least distance between corners
    view_features: int = 500  # ORB features of a keyframe, for other agents and for relocalisation
    noise_px: float = 1.0  # standard deviation of one tracked corner
    ransac_px: float = 3.0  # reprojection error up to which a point belongs to the consensus
    gate_sigma: float = 3.0  # an observation further off is an outlier
    min_inliers: int = 15  # points that agree with a pose; fewer: LOST
    weak_inliers: int = 40  # fewer: WEAK
    keyframe_m: float = 0.15  # a keyframe after this much motion since the last one,
    keyframe_rad: float = 0.15  # or this much turning,
    keyframe_tracked: float = 0.6  # or when fewer than this part of its points are left
    keyframe_gap_s: float = 0.1  # but never sooner
    max_keyframes: int = 60  # of the local map; a full one drops the keyframe nearest to another
    reobserve_hosts: int = 6  # earlier keyframes whose points are looked for again
    reobserve_m: float = 1.0  # which of them: no further away than this,
    reobserve_rad: float = 0.5  # and turned by no more than this
    reobserve_px: float = 3.0  # and are taken up again if found so near to where they should be
    relocalise_hosts: int = 8  # keyframes of the local map that a LOST frame is compared with
    new_stretch_s: float = 3.0  # LOST this long: odometry begins anew
    max_speed_m_s: float = 5.0  # a pose that implies more is not believed
    max_turn_rad_s: float = 12.0  # the same, for turning

    def __post_init__(self) -> None:
        _require_positive(self, "corners", "spacing_px", "view_features", "noise_px", "ransac_px")
        _require_positive(self, "gate_sigma", "min_inliers", "max_keyframes")


@dataclass(frozen=True)
class InertialConfig:
    """Tracking by cameras and IMU (`share.odometry`)."""

    features: int = 80  # followed at a time
    spacing_px: float = 18.0  # least distance between new ones
    sigma_px: float = 0.15  # of a feature found again, anew in every image,
    lasting_px: float = 0.3  # and of what is wrong with it for longer: edges, patches seen from elsewhere;
    stereo_px: float = 0.25  # of a new feature's disparity
    common_rad: float = 1e-3  # error of an image that all its features share: its blur, its time
    common_m: float = 1e-4  # the same, as a shift of the camera
    gate: float = 12.0  # squared Mahalanobis distance, 2 degrees of freedom, beyond which a sight is refused
    alike: float = 0.85  # correlation with the first patch below which a feature is not seen
    settled_px: float = 0.3  # a last correction larger than this is no find
    reach_px: float = 4.0  # how far alignment may wander from where a feature was expected
    imu_noise: float = 2.0  # times what the IMU's data sheet says
    gyro_bias: float = 0.02  # rad/s, to begin with
    accel_bias: float = 0.3  # m/s^2, the same
    extrinsic_rad: float = 1e-5  # what is not known of the camera's place on the body; small: taken as it is
    extrinsic_m: float = 1e-5  # the same, of its position
    offset_s: float = 1e-6  # the same of its time against the IMU's
    gravity: float = 9.81  # m/s^2
    keyframe_m: float = 0.25  # a keyframe after this much motion since the last one,
    keyframe_rad: float = 0.35  # or this much turning,
    keyframe_seen: float = 0.8  # or when fewer than this part of its features are seen
    keyframe_gap_s: float = 0.1  # but never sooner
    max_keyframes: int = 20  # in the state
    recall: int = 80  # features of earlier keyframes looked for again at a keyframe,
    recall_m: float = 1.5  # of keyframes no further away than this
    recall_rad: float = 0.7  # and turned by no more than this
    weak: int = 25  # features seen; fewer: WEAK
    blind: int = 6  # fewer: INERTIAL_ONLY
    max_speed_m_s: float = 8.0  # a state that is faster is LOST
    lost_m: float = 0.5  # sigma of a position since the last sight that is LOST
    silent_s: float = 0.1  # an IMU that says nothing for longer is taken as silent
    turning_noise: float = 0.5  # rad/s/sqrt(Hz), how a body's turning may change meanwhile
    moving_noise: float = 1.0  # m/s^2/sqrt(Hz), the same of its velocity

    def __post_init__(self) -> None:
        _require_positive(self, "features", "spacing_px", "sigma_px", "gate", "imu_noise", "gravity")
        _require_positive(self, "max_keyframes")


@dataclass(frozen=True)
class PlaceConfig:
    """When two views are taken for the same place."""

    candidates: int = 8  # keyframes verified per query, best first
    enough: int = 3  # verified ones after which the rest is left alone
    tables: int = 8  # hash tables of the index
    hash_bits: int = 16  # descriptor bits that make a word in each of them
    index_seed: int = 1  # which bits
    max_distance_bits: int = 64  # of 256: a match of two descriptors
    min_matches: int = 20  # mutual nearest neighbours, before any geometry
    ransac_px: float = 6.0  # reprojection error of a rough pose's inlier
    ransac_iterations: int = 300  # at most, best matches first
    reverse_iterations: int = 900  # the same, of the reverse direction, in no order
    min_consensus: int = 8  # inliers of a rough pose: one view's 3D points in the other's image
    guided_bits: int = 80  # a match beside where the rough pose moves the point may differ in so many bits
    guided_px: float = 15.0  # what "beside" is
    agree_depth_ratio: float = 0.05  # poses are the same if positions differ less than this times the depth
    agree_deg: float = 2.5  # … and rotations less than this
    rival_share: float = 0.5  # another pose with more than this share of the inliers: refused
    sigma_px: float = 1.5  # standard deviation of a keypoint
    sigma_inverse_depth: float = 0.01  # 1/m, of a keypoint's depth: disparity noise / (focal * baseline)
    inlier_chi2: float = 11.3  # squared Mahalanobis distance of an inlier (99 %, 3 dof)
    min_inliers: int = 20  # after refinement; fewer: refused
    min_direction_inliers: int = 10  # of them, those that know the query's depth; and the candidate's
    max_sigma_deg: float = 0.5  # a pose more uncertain than this is refused
    min_spread: float = 0.05  # narrow side (1 sigma) of the inliers, normalised coordinates
    gravity_deg: float = 6.0  # rotation must keep "up" within this, where both views know it
    floor_deg: float = 0.1  # added to what the residuals say: what inliers do not average away
    floor_m: float = 0.005  # the same, for the position

    def __post_init__(self) -> None:
        _require_positive(self, "candidates", "enough", "tables", "hash_bits", "ransac_px")
        _require_positive(self, "ransac_iterations", "reverse_iterations", "guided_px")
        _require_positive(self, "sigma_px", "sigma_inverse_depth", "inlier_chi2")
        if self.tables << self.hash_bits > 1 << 22:
            raise ValueError(f"hash_bits: {self.tables} tables of {self.hash_bits} bits are too many words")


@dataclass(frozen=True)
class AgentConfig:
    """What an agent keeps, sends and makes of corrections."""

    keep_keyframes: int = 600  # that an agent remembers, sent ones too: a restarted edge is given them again
    late_ms: float = 0.0  # a frame that is later when its turn comes is left out; 0: none is
    rate_burst: float = 2.0  # keyframes that may be saved up under a rate limit
    blend_jump_m: float = 0.05  # a correction that moves the body further, or turns it more,
    blend_jump_rad: float = 0.02  # is blended in
    blend_s: float = 0.5  # over this time
    finish_s: float = 5.0  # how long the end of a run waits for acknowledgements
    error_model: str = "shipped"  # how wrong the tracker is: this, a file, or "" for odometry's sigma
    tell_placement: bool = True  # the edge is told how unsurely the map placed this agent, too

    def __post_init__(self) -> None:
        _require_positive(self, "keep_keyframes", "blend_s")
        if not self.late_ms >= 0:
            raise ValueError(f"late_ms: {self.late_ms} must not be negative")
        if self.rate_burst < 1:
            raise ValueError(f"rate_burst: {self.rate_burst} must be at least 1")


@dataclass(frozen=True)
class LinkConfig:
    """The rhythm of an agent's talk with its edge."""

    hello_s: float = 0.5  # between hellos, until welcomed
    refused_s: float = 5.0  # a refused agent that already runs asks again after this
    ping_s: float = 0.5  # between pings
    silent_s: float = 3.0  # nothing heard for this long: the edge is taken as gone
    window: int = 16  # keyframes in flight
    resend_s: float = 1.0  # first wait for an acknowledgement; doubles
    resend_max_s: float = 8.0  # the longest wait it doubles to
    gap_s: float = 0.1  # the same, for a keyframe that later ones have overtaken

    def __post_init__(self) -> None:
        _require_positive(self, "hello_s", "ping_s", "silent_s", "window", "resend_s", "resend_max_s")


@dataclass(frozen=True)
class StreamConfig:
    """How agents that do not track themselves send frames to the edge that does (policy streamed)."""

    window: int = 3  # frames of an agent under way; of others the newest waits. As many wait for a tracker
    patience_s: float = 1.0  # a frame without an answer for this long has none
    begin_s: float = 20.0  # a recording is not played before the edge can track it, but then it is

    def __post_init__(self) -> None:
        _require_positive(self, "window", "patience_s")


@dataclass(frozen=True)
class ClockConfig:
    """The filter of the edge's clock against the agent's."""

    noise_us: float = 20.0  # standard deviation of an exchange that met no queue
    asymmetry: float = 0.5  # one-way error of an exchange per delay beyond the least; 0.5 is all of it
    offset_walk_us: float = 4.0  # random walk of the offset, per sqrt(s)
    drift_walk_ppm: float = 0.05  # random walk of the drift, per sqrt(s)
    drift_ppm: float = 100.0  # standard deviation of the drift before anything is known
    least_of: int = 64  # exchanges among which the least delay is sought
    gate_sigma: float = 4.0  # an exchange further off is not believed
    step_after: int = 5  # but so many in a row are: the clock was set
    claim_ms: float = 1.0  # an offset less sure than this is not told as a number (docs/do/sync.md)

    def __post_init__(self) -> None:
        _require_positive(self, "noise_us", "drift_ppm", "least_of", "gate_sigma", "step_after", "claim_ms")


@dataclass(frozen=True)
class GraphConfig:
    """How the pose graph is solved."""

    cauchy: float = 3.0  # whitened residual (6 dof: 2.4 is usual) at which a loop begins to lose weight
    max_iterations: int = 30  # of Levenberg-Marquardt; the next solution goes on where one stopped
    relative_tolerance: float = 1e-6  # of the cost, between two iterations
    step_tolerance: float = 3e-3  # rad and m; solved once no pose is moved by more
    inner_tolerance: float = 3e-2  # of the residual of a step's equations, relative
    covariance_edges: int = 250  # the surest, by which covariances are told; more: tighter and slower
    covariance_rounds: int = 16  # of looking for surest ways, at most

    def __post_init__(self) -> None:
        _require_positive(self, *(setting.name for setting in fields(self)))


@dataclass(frozen=True)
class MergeConfig:
    """What is believed before a loop may move a map."""

    min_loop_gap: int = 10  # keyframes of one stretch nearer than this are odometry's business
    agree_chi2: float = 22.5  # two loops agree, or a loop fits the map (99.9 %, 6 dof)
    surprise_chi2: float = 200.0  # beyond this a loop contradicts the map whatever witnesses say
    odometry_scale: float = 1.0  # agents' sigmas are this much too small
    odometry_floor_deg: float = 0.002  # per edge, added in quadrature
    odometry_floor_m: float = 0.0002  # the same, for the position
    odometry_floor_per_rad: float = 0.0005  # the same, a part of what the edge turns,
    odometry_floor_per_m: float = 0.003  # and of what it moves: no agent is surer of itself
    gravity_floor_deg: float = 0.1  # the same, of an agent's up: what its calibration may be wrong
    most_loops: int = 10  # of a keyframe, when those of others that are taken out are moved to it
    max_pending: int = 200  # loops that wait for a witness; the oldest is dropped
    place_m: float = 0.5  # views further apart than this,
    place_rad: float = 0.35  # or turned by more, are of different places
    near_m: float = 2.5  # two views further apart than this,
    near_rad: float = 0.8  # or turned by more, are no witnesses for a join
    join_places: int = 2  # at so many places maps must fit to be joined; of a smaller map, at all but one
    join_found: float = 0.3  # of the points that two views should share, so many must be found, on average
    overlap_pairs: int = 0  # so many pairs of views from one spot must tell whether two maps look alike
    overlap_gone: float = 0.06  # of what they should share, no more may be things that are gone
    undo_doubt: float = 0.6  # what is gone beyond that, summed over views: more forbids or undoes a join
    rival_weight: float = 0.5  # no contradicting story may weigh more than this part of the one that joins
    enter_m: float = 0.05  # who is known worse than this (1 sigma) waits to hear of another's map,
    enter_patience: int = 20  # but for so many of his keyframes that found loops at most
    rebel_places: int = 4  # so many places at least, that weigh more than what stands, take a map apart
    rebel_weight: float = 1.4  # by how many times they have to weigh more
    scale_tolerance: float = 0.015  # agents whose depths or ways differ by more (1.5 %) keep apart
    drop_chi2: float = 1000.0  # a solved graph at odds with a loop by more than this drops it

    def __post_init__(self) -> None:
        _require_positive(self, "min_loop_gap", "most_loops", "max_pending")


STREAMED = "streamed"
POLICY_NAMES = ("share", "covins-g", "linear", "equal", "random", STREAMED)  # see `share.scheduling.policies`


@dataclass(frozen=True)
class EdgeConfig:
    """How the edge serves its agents."""

    policy: str = "share"  # what `share edge --policy` says goes before it
    silent_s: float = 3.0  # nothing heard of an agent for this long: it is taken as gone
    name_hold_s: float = 3.0  # a name stays taken so long after its agent was last heard
    max_agents: int = 64  # present at a time; more are refused
    max_keyframes: int = 2000  # kept; beyond, who holds most gives, first what has others like it
    max_waiting: int = 12  # keyframes that queue to be looked up; beyond, the oldest is only stored
    each_waiting: int = 3  # the same, of one agent
    hurry_waiting: int = 1  # so many queue: the look-up at hand tries fewer candidates,
    hurry_candidates: int = 3  # at most these, and one that is verified is enough

    def __post_init__(self) -> None:
        if self.policy not in POLICY_NAMES:
            raise ValueError(f"policy: '{self.policy}' is not known; known: {', '.join(POLICY_NAMES)}")
        _require_positive(self, "max_agents", "max_keyframes", "max_waiting", "each_waiting")
        _require_positive(self, "hurry_waiting", "hurry_candidates")


@dataclass(frozen=True)
class AgentQoe:
    """What one agent needs, under its name in `control.agents`; None is what its form has."""

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
    """How agents are rated, what they may send, what is merged (docs/understand/scheduling.md)."""

    ar_beta: float = 0.015  # 1/ms, of delay beyond 20 ms
    ar_gamma: float = 3.6  # cm, of accuracy
    ar_target: float = 0.93  # QoE that is aimed at
    robot_beta: float = 3.0  # cm, of accuracy short of 1/cm
    robot_gamma: float = 400.0  # ms, of 1 / (delay + theta)
    robot_theta_ms: float = 20.0  # a delay well below this is as good as none
    robot_target: float = 0.9  # QoE that is aimed at
    signed_penalty: bool = False  # what is better than asked for raises QoE beyond 1, as the paper prints it
    agents: dict[str, AgentQoe] = field(default_factory=dict)  # NAME: {form, beta, gamma, theta_ms, target}
    attribution: bool = True  # a QoE that is short because of delay lowers the rate, unlike in the paper
    kp: float = 0.8  # Hz per evaluation, of an error of 1 in QoE
    ki: float = 0.15  # the same, of an error of 1 for a second
    kd: float = 0.2  # the same, of an error that grows by 1 in a second
    alpha: float = 0.3  # weight of the newest slope of the error, of 1
    integral_max_hz: float = 0.1  # the integral's part of a step, at most
    rate_min_hz: float = 1.5  # keyframes an agent may always send
    rate_max_hz: float = 5.0  # and the most it may; its rate to begin with
    gap_s: float = 5.0  # no evaluation for longer: the error's slope is forgotten, its integral held
    random_seed: int = 1  # of policy random
    gate_seed: int = 1  # of which merges are skipped
    near_m: float = 0.3  # what a camera sees is reckoned from here
    far_m: float = 5.0  # to here, its field of view as calibrated
    interval_m: float = 0.5  # between points at which overlap is sampled
    merges: int = 20  # completed ones, with whose mean overlap a new one is compared
    eagerness: float = 1.5  # a merge is done with this chance, times its overlap as a part of their mean

    def __post_init__(self) -> None:
        _require_positive(self, "ar_gamma", "robot_gamma", "robot_theta_ms", "rate_min_hz", "merges")
        _require_positive(self, "interval_m")
        if not self.near_m < self.far_m:
            raise ValueError(f"near_m: {self.near_m} m is not nearer than far_m, {self.far_m} m")
        if not (self.rate_min_hz <= self.rate_max_hz <= 1000 and self.alpha <= 1):
            raise ValueError("rate_min_hz, rate_max_hz, 1000 must rise, and alpha be at most 1")


@dataclass(frozen=True)
class Config:
    """The whole; one section per part."""

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
    """A `Config` from YAML text. Raises ConfigError naming the key and what would be right."""
    data = load_yaml(text, where)
    return from_mapping(Config, {} if data is None else data, where)
