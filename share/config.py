"""The configuration: every key with its unit and default. The effective configuration is written beside the
results of every run.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

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
    """Tracking by cameras alone (`share.odometry.visual_tracker`); the views of any tracker."""

    corners: int = 250  # features tracked at once

    def __post_init__(self) -> None:
        _require_positive(self, "corners")


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

    candidates: int = 8  # keyframes verified per query, best first; more find more loops and take longer

    def __post_init__(self) -> None:
        _require_positive(self, "candidates")


@dataclass(frozen=True)
class AgentConfig:
    """The agent: keyframes, corrections, error model."""

    keep_keyframes: int = 600  # keyframes kept, sent ones included, to resend to a restarted edge
    late_ms: float | None = None  # later frames get a pose from the IMU; 0: none; null: 100, a robot 400
    blend_s: float = 0.5  # time constant with which the pose follows a correction
    finish_s: float = 5.0  # longest wait for acknowledgements at the end of a run
    error_model: str = ""  # error model: shipped, a file, or "" for odometry's covariance

    def __post_init__(self) -> None:
        _require_positive(self, "keep_keyframes", "blend_s")
        if self.late_ms is not None and not self.late_ms >= 0:
            raise ValueError(f"late_ms: {self.late_ms} must not be negative")


@dataclass(frozen=True)
class LinkConfig:
    """The link between agent and edge."""

    silent_s: float = 3.0  # no message for this long: the edge counts as gone

    def __post_init__(self) -> None:
        _require_positive(self, "silent_s")


@dataclass(frozen=True)
class StreamConfig:
    """Streaming of frames to an edge that tracks them (policy streamed)."""

    window: int = 3  # frames in flight per agent, and as many at its tracker; beyond, the newest waits

    def __post_init__(self) -> None:
        _require_positive(self, "window")


@dataclass(frozen=True)
class ClockConfig:
    """The edge's clock as the agent reports it."""

    claim_ms: float = 1.0  # an offset with a larger uncertainty is not reported (docs/do/sync.md)

    def __post_init__(self) -> None:
        _require_positive(self, "claim_ms")


@dataclass(frozen=True)
class MergeConfig:
    """Acceptance of loops and merging of maps."""

    join_places: int = 2  # places that must agree before maps merge; of a smaller map, all but one
    overlap_pairs: int = 0  # least number of overlapping view pairs before maps merge, where rooms are copies
    enter_m: float = 0.025  # an agent waits for its correction while what is 3 m ahead has a larger sigma

    def __post_init__(self) -> None:
        _require_positive(self, "join_places")


BASE_POLICY = "covins-g"  # to which the others are compared
STREAMED = "streamed"
POLICY_NAMES = (
    "share",
    "share-paper",
    BASE_POLICY,
    "linear",
    "equal",
    "random",
    "fixed",
    STREAMED,
)  # see `share.scheduling.policies`


@dataclass(frozen=True)
class EdgeConfig:
    """Limits of the edge."""

    policy: str = "share"  # scheduling policy; overridden by --policy
    silent_s: float = 3.0  # no message of an agent for this long: it counts as gone
    max_agents: int = 64  # present at once; more are refused
    max_keyframes: int = 2000  # kept; beyond, the agent with most gives up redundant ones first
    keep_days: float | None = None  # older keyframes, pictures of the room, are forgotten; null: none are
    max_waiting: int = 12  # queued queries; beyond, the oldest keyframe is only stored

    def __post_init__(self) -> None:
        if self.policy not in POLICY_NAMES:
            raise ValueError(f"policy: '{self.policy}' is not known; known: {', '.join(POLICY_NAMES)}")
        _require_positive(self, "max_agents", "max_keyframes", "max_waiting")
        if self.keep_days is not None:
            _require_positive(self, "keep_days")


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


NEAR_M = 0.3  # near plane of the view frusta


@dataclass(frozen=True)
class ControlConfig:
    """QoE, keyframe rates and the merge gate (docs/understand/scheduling.md)."""

    ar_beta: float = 0.015  # 1/ms, of delay above 20 ms
    ar_gamma: float = 3.6  # cm, of accuracy: 1.6 is content with 0.6 cm, and asks for fewer keyframes
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
    rate_min_hz: float = 1.5  # lowest rate by QoE; only where the air is short are there lower ones
    rate_max_hz: float = 5.0  # highest rate of an agent, and the initial one by QoE
    fixed_rate_hz: float = 1.5  # rate of every agent by policy fixed; at most `rate_max_hz`
    fixed_jpeg_quality: int | None = None  # of pictures by policy fixed; null: 50
    random_seed: int = 1  # of the merge gate and of policy random
    far_m: float = 5.0  # far plane of the view frusta; the near one is at 0.3 m
    merges: int = 20  # completed merges in the mean overlap that a new one is compared with (N)
    eagerness: float = 1.5  # a merge has this probability times its overlap over their mean (alpha_m)

    def __post_init__(self) -> None:
        _require_positive(self, "ar_gamma", "robot_gamma", "robot_theta_ms", "rate_min_hz", "merges")
        _require_positive(self, "fixed_rate_hz")
        if self.fixed_rate_hz > max(self.rate_max_hz, ControlConfig.fixed_rate_hz):
            raise ValueError(
                f"fixed_rate_hz: {self.fixed_rate_hz:g} Hz is above rate_max_hz, {self.rate_max_hz:g} Hz; "
                "raise that too"
            )
        if self.fixed_jpeg_quality is not None and not 1 <= self.fixed_jpeg_quality <= 100:
            raise ValueError(f"fixed_jpeg_quality: {self.fixed_jpeg_quality} is outside 1 .. 100")
        if not self.far_m > NEAR_M:
            raise ValueError(f"far_m: {self.far_m} m is not beyond the near plane, {NEAR_M} m")
        if not self.rate_min_hz <= self.rate_max_hz <= 1000:
            raise ValueError("rate_min_hz, rate_max_hz, 1000 must rise")


@dataclass(frozen=True)
class Config:
    """The whole configuration, one section per part."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    sequencer: SequencerConfig = field(default_factory=SequencerConfig)
    place: PlaceConfig = field(default_factory=PlaceConfig)
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
    return load_given_config(text, where)[0]


def load_given_config(text: str, where: str = "configuration") -> tuple[Config, dict[str, Any]]:
    """Return a `Config` from YAML text, and only what the text sets, by section. Raises ConfigError."""
    from share.plain_data import from_mapping
    from share.strict_yaml import load_yaml

    data = load_yaml(text, where)
    refuse_retired(data, where)
    given = {} if data is None else data
    return from_mapping(Config, given, where), given


def with_policy(config: Config, policy: str) -> Config:
    """Return `config` with this scheduling policy."""
    return replace(config, edge=replace(config.edge, policy=policy))
